"""Who has to wait before the edge's socket: the kernel lets none of their data in until they are released.

After somebody was cut off, newcomers are held until what still waits of it is thrown away: one of them could
have its descriptor next. And for a while those from an address whose offender is not known more closely.
"""

from __future__ import annotations

from collections.abc import Iterable

from share.net import tcp
from share.net.connection import Connection

_PAUSE_S = 0.3  # without newcomers from an address
_AT_ONCE = 4  # that were held are let in: an attacker may have sent many
_SETTLES_S = 0.05  # until all that libzmq has read of a connection that was cut off is there to be received
_ADDRESSES = 4096


class Gate:
    def __init__(self) -> None:
        self._listener: tuple[int, int] | None = None  # descriptor and cookie
        self._is_closed = False  # who is accepted is held from the start
        self._discarded: frozenset[int] = frozenset()  # descriptors; read by other threads
        self._cut_off_s = 0.0  # when the last was
        self._paused: dict[str, float] = {}  # addresses, until when

    def listen(self, descriptor: int) -> None:
        """The socket that accepts."""
        number = tcp.cookie(descriptor)
        self._listener = None if number is None else (descriptor, number)

    def discards(self, descriptor: int) -> bool:
        """Whether what still comes from that connection is to be thrown away."""
        return descriptor in self._discarded

    @property
    def discards_any(self) -> bool:
        return bool(self._discarded)

    def discard(self, descriptor: int) -> None:
        """Nothing of that connection has been read."""
        self._discarded |= {descriptor}

    def cut_off(self, descriptor: int, now_s: float) -> None:
        """That connection was, while some of what it sent may wait."""
        self.discard(descriptor)
        self._cut_off_s = now_s

    def empty(self, empty_s: float) -> None:
        """Nothing waited when asked at `empty_s`."""
        if empty_s > self._cut_off_s + _SETTLES_S:
            self._discarded = frozenset()

    def pause(self, address: str, now_s: float) -> None:
        """Nobody new from there for a while."""
        if address in self._paused or len(self._paused) < _ADDRESSES:
            self._paused[address] = now_s + _PAUSE_S

    def holds(self, address: str, now_s: float) -> bool:
        """Whether newcomers from there have to wait."""
        return bool(self._discarded) or now_s < self._paused.get(address, now_s)

    def admit(self, connection: Connection, is_full: bool, now_s: float) -> None:
        """A newcomer: held, or let through."""
        if is_full or self.holds(connection.address, now_s):
            connection.is_held = tcp.hold(connection.descriptor, connection.cookie)
        else:  # it may have come while the gate was closed
            tcp.release(connection.descriptor, connection.cookie)

    def let_in(self, connections: Iterable[Connection], is_full: bool, now_s: float) -> list[Connection]:
        """Releases some of those who need not wait any longer; closes or opens the gate for those to come."""
        held = [c for c in connections if c.is_held and not (is_full or self.holds(c.address, now_s))]
        released = held[:_AT_ONCE]  # who came first
        for connection in released:
            tcp.release(connection.descriptor, connection.cookie)
            connection.is_held = False
        self._paused = {address: until_s for address, until_s in self._paused.items() if now_s < until_s}
        close = is_full or bool(self._paused) or self.discards_any
        if close != self._is_closed and self._listener is not None:
            (tcp.hold if close else tcp.release)(*self._listener)
            self._is_closed = close
        return released


# ---- Who is kept out, and for how long: longer with each time. Pure: time comes as an argument.

FIRST_S = 10.0
MOST_S = 600.0
_REMEMBERED = 256


class KeepOut:
    """By name: a key or an address. After MOST_S without an offence one begins anew."""

    def __init__(self) -> None:
        self._ends: dict[str, tuple[float, float]] = {}  # until when and for how long, oldest first

    def offend(self, who: str, now_s: float) -> float:
        """For how many seconds it is kept out from now."""
        until_s, lasted_s = self._ends.pop(who, (now_s, 0.0))
        forgiven = now_s > until_s + MOST_S
        lasts_s = (
            FIRST_S
            if forgiven or not lasted_s
            else lasted_s
            if now_s < until_s
            else min(2 * lasted_s, MOST_S)
        )
        if len(self._ends) >= _REMEMBERED:
            del self._ends[min(self._ends, key=lambda name: self._ends[name][0])]
        self._ends[who] = now_s + lasts_s, lasts_s
        return lasts_s

    def holds(self, who: str, now_s: float) -> bool:
        return who in self._ends and now_s < self._ends[who][0]
