"""Base delay: the minimum delay of the last minutes, present at any keyframe rate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

_MINUTE_NS = 60_000_000_000
_BASE_DELAY_MINUTES = 10  # after a change to a slower network the old minimum expires


@dataclass(frozen=True)
class BaseDelay:
    """Base delay of one agent: the minimum of the last minutes, which does not depend on what it sends.

    minima: ms by minute. Source: LEDBAT (RFC 6817, 3.4.2 and 4.2), which attributes delay above it to
    queues."""

    minima: Mapping[int, float] = field(default_factory=dict)

    @property
    def ms(self) -> float:
        """The base delay, ms; inf before the first delay."""
        return min(self.minima.values(), default=math.inf)

    def with_delay(self, delay_ms: float, now_ns: int) -> BaseDelay:
        """Return the base delay with one more measurement, at `now_ns`."""
        minute = now_ns // _MINUTE_NS
        minima = {old: ms for old, ms in self.minima.items() if minute - old < _BASE_DELAY_MINUTES}
        minima[minute] = min(delay_ms, minima.get(minute, math.inf))
        return BaseDelay(minima)
