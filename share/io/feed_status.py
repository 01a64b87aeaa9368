"""How a live camera does: for a live line, and for a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from share.core.intake import Intake
from share.core.watchdog import Health, Watchdog

_OVER_S = 1.0


@dataclass(frozen=True)
class FeedStatus:
    """rates_hz: samples of every stream in the last second; missing, dropped: so far; queue: that wait."""

    health: Health
    rates_hz: dict[str, float]
    missing: int
    dropped: int
    queue: int

    def __str__(self) -> str:
        rates = " ".join(f"{name} {hz:.0f}" for name, hz in self.rates_hz.items())
        counts = f"missing {self.missing}  dropped {self.dropped}  queue {self.queue}"
        return f"{self.health.value}  {rates} Hz  {counts}"


class Rates:
    """Counts to rates over about a second."""

    def __init__(self) -> None:
        self._then: tuple[float, Mapping[str, int]] | None = None
        self._rates: dict[str, float] = {}

    def of(self, counts: Mapping[str, int], now_s: float) -> dict[str, float]:
        """Hz by name; before the first second is over, 0."""
        if self._then is None:
            self._then, self._rates = (now_s, counts), dict.fromkeys(counts, 0.0)
        since_s, before = now_s - self._then[0], self._then[1]
        if since_s >= _OVER_S:
            self._rates = {name: (count - before.get(name, 0)) / since_s for name, count in counts.items()}
            self._then = (now_s, counts)
        return self._rates


def feed_report(intake: Intake, dropped: Mapping[str, int], watchdog: Watchdog) -> dict[str, Any]:
    """What came, was repaired and lost, as plain data (docs/capture.md)."""
    streams = {
        name: {
            "samples": gaps.samples,
            "seconds": round(gaps.seconds, 3),
            "gaps": gaps.gaps,
            "missing": gaps.missing,
            "backward": gaps.backward,
            "dropped": dropped.get(name, 0),
        }
        for name, gaps in intake.streams.items()
    }
    return {
        "streams": streams,
        "imu": intake.join.joined,
        "stretches": intake.stretches,
        "reconnections": watchdog.reconnections,
        "resets": watchdog.resets,
        "health": watchdog.health.value,
        **intake.counts(),
    }
