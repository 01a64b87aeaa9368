"""Whether an agent may say how far the edge's clock is off, and so compare the stamps of two machines.

Nothing that is called latency or delay needs it: `track_ms`, `corrected_ms` and the delay of an
evaluation are each a difference of two times of the agent's own clock, and a round trip is the agent's
time less what the edge's clock says that it kept the question. What begins by one clock and ends by the
other, such as the way there alone, is known no better than the offset.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from share.core.clock import ClockFilter


@dataclass(frozen=True)
class ClockClaim:
    """Of the edge's monotonic clock minus the agent's, ms. sigma_ms: standard deviation by the filter;
    asymmetry_ms: half of the least recent round trip by the agent's own clock, which no filter sees and no
    word of the edge makes smaller; None before exchanges that agree. offset_ms: None too where it is not
    claimed."""

    offset_ms: float | None
    sigma_ms: float | None
    asymmetry_ms: float | None
    claim_ms: float  # setting `clock.claim_ms`

    @classmethod
    def of(cls, clock: ClockFilter, now_ns: int, claim_ms: float) -> ClockClaim:
        """At `now_ns`: what was not asked for long is known less."""
        offset_ns, sigma_ns, asymmetry_ns = (
            clock.offset_ns(now_ns),
            clock.sigma_ns(now_ns),
            clock.asymmetry_ns,
        )
        if not clock.is_witnessed or offset_ns is None or sigma_ns is None or asymmetry_ns is None:
            return cls(None, None, None, claim_ms)
        found = cls(offset_ns / 1e6, sigma_ns / 1e6, asymmetry_ns / 1e6, claim_ms)
        return found if found.claimed else cls(None, found.sigma_ms, found.asymmetry_ms, claim_ms)

    @property
    def uncertainty_ms(self) -> float | None:
        if self.sigma_ms is None or self.asymmetry_ms is None:
            return None
        return self.sigma_ms + self.asymmetry_ms

    @property
    def claimed(self) -> bool:
        return self.uncertainty_ms is not None and self.uncertainty_ms <= self.claim_ms

    def report(self) -> dict[str, Any]:
        """Plain data."""
        return {**asdict(self), "uncertainty_ms": self.uncertainty_ms, "claim": self.claimed}
