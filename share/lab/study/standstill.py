"""When a robot began to move and since when it stands, from its places a few times a second.

Corrections of the map move a robot that stands by centimetres: by the map, less than StandstillLimits has
is no motion.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

_ROUNDING_S = 1e-6


@dataclass(frozen=True)
class StandstillLimits:
    """What is motion, and what a standstill; the defaults: of places by a map, some five a second.

    moved_m, turned_rad: from where it was called, beyond one of which it has begun to move. still_m,
    still_rad, still_s: within the first two for so long, it stands. counted_m: of a way; less is noise.
    max_gap_s: between two places, over which nothing is said to have stood.
    """

    moved_m: float = 0.05
    turned_rad: float = 0.15
    still_m: float = 0.03
    still_rad: float = 0.1
    still_s: float = 1.0
    counted_m: float = 0.03
    max_gap_s: float = 1.5


BY_MAP = StandstillLimits()
BY_TRUTH = StandstillLimits(moved_m=0.02, turned_rad=0.05, still_m=0.005, still_rad=0.01, still_s=0.5)


@dataclass(frozen=True)
class RobotSample:
    """Where the robot was: x, y in m, yaw in rad."""

    t_s: float
    x: float
    y: float
    yaw: float

    def is_near(self, other: RobotSample, m: float, rad: float) -> bool:
        turned = abs(math.remainder(self.yaw - other.yaw, 2 * math.pi))
        return math.hypot(self.x - other.x, self.y - other.y) <= m and turned <= rad


class MotionWatch:
    """Follows the robot from a call on. moves_s: its first motion; None before. path_m: driven since."""

    def __init__(self, at_call: RobotSample | None, limits: StandstillLimits = BY_MAP) -> None:
        self._limits = limits
        self.moves_s: float | None = None
        self.path_m = 0.0
        self._begin = self._counted = at_call
        self._recent: deque[RobotSample] = deque()
        if at_call is not None:
            self._recent.append(at_call)

    @property
    def newest(self) -> RobotSample | None:
        return self._recent[-1] if self._recent else None

    def add(self, sample: RobotSample) -> None:
        """Take the next place."""
        limits = self._limits
        if self._begin is None:  # where it stood at the call is not known: from its first place on
            self._begin = self._counted = sample
        if self.moves_s is None and not sample.is_near(self._begin, limits.moved_m, limits.turned_rad):
            self.moves_s = sample.t_s
        counted = self._counted or sample
        step_m = math.hypot(sample.x - counted.x, sample.y - counted.y)
        if step_m >= limits.counted_m:
            self.path_m += step_m
            self._counted = sample
        if self._recent and sample.t_s - self._recent[-1].t_s > limits.max_gap_s:
            self._recent.clear()
        self._recent.append(sample)
        while not self._recent[0].is_near(sample, limits.still_m, limits.still_rad):
            self._recent.popleft()

    def stands_since(self) -> float | None:
        """Return since when it stands; None while it does not, or not for long enough."""
        if not self._recent:
            return None
        since_s = self._recent[0].t_s
        lasts = self._recent[-1].t_s - since_s >= self._limits.still_s - _ROUNDING_S
        return since_s if lasts else None
