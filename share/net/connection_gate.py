"""Connections to the edge's socket, and its gate: the kernel keeps back the data of new ones until they are
released.

After a connection was aborted, new ones are held until its waiting data are discarded, since one of them may
reuse its descriptor. New connections from an address are also held for a while if an offender there could
not be identified.
"""

from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import dataclass
from ipaddress import ip_address

from share.net import tcp
from share.net.backlog import Backlog

_ADDRESS_PAUSE_S = 0.3  # during which new connections from an address are held
_RELEASES_PER_CHECK = 4  # held connections released at a time: an attacker may have opened many
_DRAIN_S = 0.05  # until libzmq delivers all that it has read of an aborted connection
_MAX_ADDRESSES = 4096
FIRST_BLOCK_S = 10.0
MAX_BLOCK_S = 600.0
_MAX_ENTRIES = 256


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


class ConnectionGate:
    def __init__(self) -> None:
        self._listener: tuple[int, int] | None = None  # descriptor and cookie
        self._is_closed = False  # new connections are held from accept(2) on
        self._discarded: frozenset[int] = frozenset()  # descriptors; read by other threads
        self._last_abort_s = 0.0
        self._paused_until_s: dict[str, float] = {}  # by address

    def set_listener(self, descriptor: int) -> None:
        """Set the listening socket."""
        number = tcp.socket_cookie(descriptor)
        self._listener = None if number is None else (descriptor, number)

    def is_discarding(self, descriptor: int) -> bool:
        """Return whether messages from that connection are to be discarded."""
        return descriptor in self._discarded

    @property
    def is_discarding_any(self) -> bool:
        return bool(self._discarded)

    def discard(self, descriptor: int) -> None:
        """Discard all further messages from that connection."""
        self._discarded |= {descriptor}

    def record_abort(self, descriptor: int, now_s: float) -> None:
        """Record that the connection was aborted while its data may still wait."""
        self.discard(descriptor)
        self._last_abort_s = now_s

    def record_empty(self, empty_s: float) -> None:
        """Record that no message waited at `empty_s`."""
        if empty_s > self._last_abort_s + _DRAIN_S:
            self._discarded = frozenset()

    def pause_address(self, address: str, now_s: float) -> None:
        """Hold new connections from `address` for a while."""
        if address in self._paused_until_s or len(self._paused_until_s) < _MAX_ADDRESSES:
            self._paused_until_s[address] = now_s + _ADDRESS_PAUSE_S

    def is_held(self, address: str, now_s: float) -> bool:
        """Return whether new connections from `address` are held."""
        return bool(self._discarded) or now_s < self._paused_until_s.get(address, now_s)

    def admit(self, connection: Connection, is_full: bool, now_s: float) -> None:
        """Hold or let through a new connection. is_full: no more data may wait."""
        if is_full or self.is_held(connection.address, now_s):
            connection.is_held = tcp.hold_input(connection.descriptor, connection.cookie)
        else:  # it may have been accepted while the gate was closed
            tcp.release_input(connection.descriptor, connection.cookie)

    def release_waiting(
        self, connections: Iterable[Connection], is_full: bool, now_s: float
    ) -> list[Connection]:
        """Release some connections that need not be held any longer, and return them. Close or open the gate
        for new ones."""
        waiting = [c for c in connections if c.is_held and not (is_full or self.is_held(c.address, now_s))]
        released = waiting[:_RELEASES_PER_CHECK]  # oldest first
        for connection in released:
            tcp.release_input(connection.descriptor, connection.cookie)
            connection.is_held = False
        self._paused_until_s = {
            address: until_s for address, until_s in self._paused_until_s.items() if now_s < until_s
        }
        should_close = is_full or bool(self._paused_until_s) or self.is_discarding_any
        if should_close != self._is_closed and self._listener is not None:
            (tcp.hold_input if should_close else tcp.release_input)(*self._listener)
            self._is_closed = should_close
        return released


class Blocklist:
    """Blocked keys and addresses. The duration doubles with each offence, up to MAX_BLOCK_S, and starts anew
    after MAX_BLOCK_S without one. Pure: times are passed in."""

    def __init__(self) -> None:
        self._blocks: dict[str, tuple[float, float]] = {}  # end and duration, oldest first

    def block(self, peer: str, now_s: float) -> float:
        """Block `peer` from now. Return the duration, s."""
        until_s, previous_s = self._blocks.pop(peer, (now_s, 0.0))
        is_forgiven = now_s > until_s + MAX_BLOCK_S
        duration_s = (
            FIRST_BLOCK_S
            if is_forgiven or not previous_s
            else previous_s
            if now_s < until_s
            else min(2 * previous_s, MAX_BLOCK_S)
        )
        if len(self._blocks) >= _MAX_ENTRIES:
            del self._blocks[min(self._blocks, key=lambda name: self._blocks[name][0])]
        self._blocks[peer] = now_s + duration_s, duration_s
        return duration_s

    def is_blocked(self, peer: str, now_s: float) -> bool:
        return peer in self._blocks and now_s < self._blocks[peer][0]
