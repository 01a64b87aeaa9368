"""Which merges are skipped: those whose overlap is small against that of the merges before.

P_skip = max(0, 1 - alpha_m V_new / V), V the mean overlap of the last N completed merges. Source: SHARE,
IMWUT 10(3) 97, 2026.
"""

from __future__ import annotations

from dataclasses import dataclass

from share.config import ControlConfig


@dataclass(frozen=True)
class Gate:
    """eagerness: alpha_m; last: N. volumes: overlaps of merges that were completed, m^3, oldest first."""

    eagerness: float
    last: int
    volumes: tuple[float, ...] = ()

    @classmethod
    def of(cls, config: ControlConfig) -> Gate:
        return cls(config.eagerness, config.merges)

    def completed(self, volume: float) -> Gate:
        """After a merge with this overlap."""
        return Gate(self.eagerness, self.last, (*self.volumes, volume)[-self.last :])

    def skip_probability(self, volume: float, joined: bool) -> float:
        """Of a merge with this overlap, m^3. joined: the two sides are in one map already.

        0 for maps that are not joined yet, and where nothing was merged that it could be compared with.
        """
        total = sum(self.volumes)
        if not joined or total <= 0:
            return 0.0
        return max(0.0, 1 - self.eagerness * volume * len(self.volumes) / total)

    def skips(self, volume: float, joined: bool, draw: float) -> bool:
        """Whether it is left out. draw: uniform in [0, 1), the caller's."""
        return draw < self.skip_probability(volume, joined)
