"""Pings of an agent and what their answers tell: the round trip, and the edge's clock."""

from __future__ import annotations

from collections import deque

from share.config import ClockConfig, LinkConfig
from share.core.clock import ClockFilter
from share.core.rate import Every
from share.wire.messages import Ping, Pong

_UNDER_WAY = 16


class Pings:
    """`clock` is that of the edge's present life."""

    def __init__(self, link: LinkConfig, clock: ClockConfig) -> None:
        self.clock = ClockFilter(clock)
        self._every = Every(link.ping_s)
        self._sequence = 0
        self._under_way: deque[Ping] = deque(maxlen=_UNDER_WAY)

    def due(self, now_ns: int) -> Ping | None:
        """The ping that goes now."""
        if not self._every.due(now_ns):
            return None
        self._sequence += 1
        self._under_way.append(Ping(self._sequence, now_ns))
        return self._under_way[-1]

    def answers(self, pong: Pong) -> bool:
        """Whether it answers a ping that waits; that waits no longer."""
        ping = Ping(pong.sequence, pong.sent_ns)
        known = ping in self._under_way
        if known:
            self._under_way.remove(ping)
        return known

    def measure(self, pong: Pong, now_ns: int) -> None:
        """An answer, which came at `now_ns`, of the present life."""
        self.clock.update(pong.sent_ns, pong.received_ns, pong.replied_ns, now_ns)

    def begin(self) -> None:
        """A new life of the edge: another clock."""
        self.clock.reset()
        self._under_way.clear()
