"""A TCP connection to the edge's socket, as `ConnectionGuard` tracks it."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from ipaddress import ip_address

from share.net import tcp
from share.net.backlog import Backlog


@dataclass(eq=False)
class Connection:
    """One connection. cookie: the kernel's, which tells whether the descriptor is still this connection.
    is_unambiguous: no message of an earlier connection with this descriptor can be waiting. is_held: the
    kernel holds back its data."""

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
        """Return what to block: the key if known, else the address unless it is local or one of
        `agent_addresses`, else None."""
        if self.key:
            return self.key
        local = ip_address(self.address.partition("%")[0]).is_loopback
        return None if local or self.address in agent_addresses else self.address

    def update_backlog(self) -> bool:
        """Record how much libzmq has read. Return False if the connection is gone."""
        same = tcp.socket_cookie(self.descriptor) == self.cookie
        read = tcp.bytes_read(self.descriptor) if same else None
        if read is not None:
            self.backlog.update_read(*read)
        return read is not None

    def abort(self) -> bool:
        """Reset the connection. Return whether it existed."""
        return tcp.abort(self.descriptor, self.cookie)
