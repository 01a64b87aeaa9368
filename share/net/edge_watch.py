"""An agent's guard against its edge: what the edge sent and the agent has not taken yet is bounded.

The agent looks itself, whenever it receives (`share.net.guard` does the same for an edge).
"""

from __future__ import annotations

from share.net import tcp
from share.net.account import Account, Bounds


class EdgeWatch:
    """Of one connection at a time."""

    def __init__(self, bounds: Bounds) -> None:
        self._bounds = bounds
        self._connection: tuple[int, int] | None = None  # descriptor and cookie
        self._account = Account(0.0)

    def connected(self, descriptor: int, now_s: float) -> None:
        """To an edge, perhaps another than before."""
        number = tcp.cookie(descriptor)
        self._connection = None if number is None else (descriptor, number)
        self._account = Account(now_s)

    def took(self, size: int, parts: int, now_s: float) -> None:
        """A message of so many bytes on the wire, in so many parts, was received."""
        self._account.took(size, parts, 1, now_s)

    def look(self) -> str | None:
        """What is too much of what waits; then the connection is broken off."""
        if self._connection is None:
            return None
        read = tcp.bytes_read(self._connection[0]) if self._is_open() else None
        if read is None:
            self._connection = None
            return None
        self._account.sample(*read)
        if self._account.exceeds(self._bounds):
            return self._break_off("many small messages" if self._account.is_tiny else "more than may wait")
        return None

    def empty(self) -> str | None:
        """There is no message now: what was read before the last time is at most a part of one. As `look`."""
        account = self._account
        if self._connection is not None and account.marked > self._bounds.message:
            return self._break_off("a message that does not end")
        account.settle()
        account.mark()
        return None

    def _is_open(self) -> bool:
        return self._connection is not None and tcp.cookie(self._connection[0]) == self._connection[1]

    def _break_off(self, reason: str) -> str:
        if self._connection is not None:
            tcp.cut(*self._connection)
        self._connection = None
        return reason
