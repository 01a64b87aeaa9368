"""A connection to the edge's socket, as its guard knows it."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from ipaddress import ip_address

from share.net import tcp
from share.net.account import Account


@dataclass(eq=False)
class Connection:
    """cookie: by which its descriptor is known to be still the same. sure: no message of an earlier
    connection with this descriptor can be waiting. is_held: the kernel lets none of its data in yet."""

    descriptor: int
    cookie: int
    address: str
    account: Account
    sure: bool
    key: str = ""
    is_cut: bool = False
    is_held: bool = False

    @property
    def strange(self) -> bool:
        return self.account.messages == 0

    @property
    def name(self) -> str:
        return f"the key '{self.key}'" if self.key else self.address

    def culprit(self, homes: Container[str]) -> str | None:
        """Whom to keep out: the key, if it is known; the address, unless agents live there (`homes`)."""
        if self.key:
            return self.key
        local = ip_address(self.address.partition("%")[0]).is_loopback
        return None if local or self.address in homes else self.address

    def sample(self) -> bool:
        """Notes how much libzmq has read; False where the connection is no longer there."""
        same = tcp.cookie(self.descriptor) == self.cookie
        read = tcp.bytes_read(self.descriptor) if same else None
        if read is not None:
            self.account.sample(*read)
        return read is not None

    def cut(self) -> bool:
        """Breaks it off. Whether it was there."""
        return tcp.cut(self.descriptor, self.cookie)
