"""The delay that an agent has whatever it sends: the least of late.

Source: LEDBAT (RFC 6817, 3.4.2 and 4.2), which takes what a delay is above that for a queue's. Minima of
single minutes, the newest ten: who has come to a worse network is measured by the better one no longer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

_MINUTE_NS = 60_000_000_000
_HISTORY = 10  # minutes


@dataclass(frozen=True)
class BaseDelay:
    """Of one agent. minima: ms by minute; none before the first delay."""

    minima: Mapping[int, float] = field(default_factory=dict)

    @property
    def ms(self) -> float:
        """inf where nothing was heard."""
        return min(self.minima.values(), default=math.inf)

    def after(self, delay_ms: float, now_ns: int) -> BaseDelay:
        """With one more, heard at `now_ns`."""
        minute = now_ns // _MINUTE_NS
        minima = {of: least for of, least in self.minima.items() if minute - of < _HISTORY}
        minima[minute] = min(delay_ms, minima.get(minute, math.inf))
        return BaseDelay(minima)
