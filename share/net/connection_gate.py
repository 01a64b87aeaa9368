"""Who has to wait before the edge's socket: the kernel lets none of their data in until they are released.

After somebody was cut off, newcomers are held until what still waits of it is thrown away: one of them could
have its descriptor next. And for a while those from an address whose offender is not known more closely.
"""

from __future__ import annotations

from collections.abc import Iterable

from share.net import tcp
from share.net.connection import Connection

_ADDRESS_PAUSE_S = 0.3  # without newcomers from an address
_RELEASES_PER_CHECK = 4  # that were held are let in: an attacker may have sent many
_DRAIN_S = 0.05  # until all that libzmq has read of a connection that was cut off is there to be received
_MAX_ADDRESSES = 4096


class ConnectionGate:
    def __init__(self) -> None:
        self._listener: tuple[int, int] | None = None  # descriptor and cookie
        self._is_closed = False  # who is accepted is held from the start
        self._discarded: frozenset[int] = frozenset()  # descriptors; read by other threads
        self._last_abort_s = 0.0  # when the last was
        self._paused_until_s: dict[str, float] = {}  # addresses, until when

    def set_listener(self, descriptor: int) -> None:
        """The socket that accepts."""
        number = tcp.socket_cookie(descriptor)
        self._listener = None if number is None else (descriptor, number)

    def is_discarding(self, descriptor: int) -> bool:
        """Whether what still comes from that connection is to be thrown away."""
        return descriptor in self._discarded

    @property
    def is_discarding_any(self) -> bool:
        return bool(self._discarded)

    def discard(self, descriptor: int) -> None:
        """Nothing of that connection has been read."""
        self._discarded |= {descriptor}

    def record_abort(self, descriptor: int, now_s: float) -> None:
        """That connection was, while some of what it sent may wait."""
        self.discard(descriptor)
        self._last_abort_s = now_s

    def record_empty(self, empty_s: float) -> None:
        """Nothing waited when asked at `empty_s`."""
        if empty_s > self._last_abort_s + _DRAIN_S:
            self._discarded = frozenset()

    def pause_address(self, address: str, now_s: float) -> None:
        """Nobody new from there for a while."""
        if address in self._paused_until_s or len(self._paused_until_s) < _MAX_ADDRESSES:
            self._paused_until_s[address] = now_s + _ADDRESS_PAUSE_S

    def is_held(self, address: str, now_s: float) -> bool:
        """Whether newcomers from there have to wait."""
        return bool(self._discarded) or now_s < self._paused_until_s.get(address, now_s)

    def admit(self, connection: Connection, is_full: bool, now_s: float) -> None:
        """A newcomer: held, or let through."""
        if is_full or self.is_held(connection.address, now_s):
            connection.is_held = tcp.hold_input(connection.descriptor, connection.cookie)
        else:  # it may have come while the gate was closed
            tcp.release_input(connection.descriptor, connection.cookie)

    def release_waiting(
        self, connections: Iterable[Connection], is_full: bool, now_s: float
    ) -> list[Connection]:
        """Releases some of those who need not wait any longer; closes or opens the gate for those to come."""
        waiting = [c for c in connections if c.is_held and not (is_full or self.is_held(c.address, now_s))]
        released = waiting[:_RELEASES_PER_CHECK]  # who came first
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


# ---- Who is kept out, and for how long: longer with each time. Pure: time comes as an argument.

FIRST_BLOCK_S = 10.0
MAX_BLOCK_S = 600.0
_MAX_ENTRIES = 256


class Blocklist:
    """By name: a key or an address. After MOST_S without an offence one begins anew."""

    def __init__(self) -> None:
        self._blocks: dict[str, tuple[float, float]] = {}  # until when and for how long, oldest first

    def block(self, peer: str, now_s: float) -> float:
        """For how many seconds it is kept out from now."""
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
