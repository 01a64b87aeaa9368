"""The delay that an agent has whatever it sends: the least of late.

Source: LEDBAT (RFC 6817, 3.4.2 and 4.2), which takes what a delay is above that for a queue's. Minima of
single minutes, the newest ten: who has come to a worse network is measured by the better one no longer.
"""

from __future__ import annotations

from dataclasses import dataclass

_MINUTE_NS = 60_000_000_000
_HISTORY = 10  # minutes


@dataclass(frozen=True)
class BaseDelay:
    """Of one agent. minima: (minute, ms), the oldest first; none before the first delay."""

    minima: tuple[tuple[int, float], ...] = ()

    @property
    def ms(self) -> float:
        """inf where nothing was heard."""
        return min((least for _, least in self.minima), default=float("inf"))

    def after(self, delay_ms: float, now_ns: int) -> BaseDelay:
        """With one more, heard at `now_ns`."""
        minute = now_ns // _MINUTE_NS
        kept = [(of, least) for of, least in self.minima if minute - _HISTORY < of != minute]
        least = min((least for of, least in self.minima if of == minute), default=delay_ms)
        return BaseDelay((*kept, (minute, min(least, delay_ms))))
