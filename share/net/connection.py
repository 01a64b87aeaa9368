"""A connection to the edge's socket, as its guard knows it."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from ipaddress import ip_address

from share.net import tcp
from share.net.backlog import Backlog


@dataclass(eq=False)
class Connection:
    """cookie: by which its descriptor is known to be still the same. sure: no message of an earlier
    connection with this descriptor can be waiting. is_held: the kernel lets none of its data in yet."""

    descriptor: int
    cookie: int
    address: str
    backlog: Backlog
    is_unambiguous: bool
    key: str = ""
    is_aborted: bool = False
    is_held: bool = False

    @property
    def is_unidentified(self) -> bool:
        return self.backlog.message_count == 0

    @property
    def name(self) -> str:
        return f"the key '{self.key}'" if self.key else self.address

    def block_target(self, agent_addresses: Container[str]) -> str | None:
        """Whom to keep out: the key, if it is known; the address, unless agents live there
        (`agent_addresses`)."""
        if self.key:
            return self.key
        local = ip_address(self.address.partition("%")[0]).is_loopback
        return None if local or self.address in agent_addresses else self.address

    def update_backlog(self) -> bool:
        """Notes how much libzmq has read; False where the connection is no longer there."""
        same = tcp.socket_cookie(self.descriptor) == self.cookie
        read = tcp.bytes_read(self.descriptor) if same else None
        if read is not None:
            self.backlog.update_read(*read)
        return read is not None

    def abort(self) -> bool:
        """Breaks it off. Whether it was there."""
        return tcp.abort(self.descriptor, self.cookie)
