"""When a robot began to move and since when it stands, from its places a few times a second.

Corrections of the map move a robot that stands by centimetres: less than MOVED_M is no motion.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

MOVED_M, TURNED_RAD = 0.05, 0.15  # from where it was called: it has begun to move
STILL_M, STILL_RAD, STILL_S = 0.03, 0.1, 1.0  # within these for so long: it stands
COUNTED_M = 0.03  # of a way; less is noise
MAX_GAP_S = 1.5  # between two places, over which nothing is said to have stood


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

    def __init__(self, at_call: RobotSample | None) -> None:
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
        if self._begin is None:  # where it stood at the call is not known: from its first place on
            self._begin = self._counted = sample
        if self.moves_s is None and not sample.is_near(self._begin, MOVED_M, TURNED_RAD):
            self.moves_s = sample.t_s
        counted = self._counted or sample
        step_m = math.hypot(sample.x - counted.x, sample.y - counted.y)
        if step_m >= COUNTED_M:
            self.path_m += step_m
            self._counted = sample
        if self._recent and sample.t_s - self._recent[-1].t_s > MAX_GAP_S:
            self._recent.clear()
        self._recent.append(sample)
        while not self._recent[0].is_near(sample, STILL_M, STILL_RAD):
            self._recent.popleft()

    def stands_since(self) -> float | None:
        """Return since when it stands; None while it does not, or not for long enough."""
        if not self._recent or self._recent[-1].t_s - self._recent[0].t_s < STILL_S:
            return None
        return self._recent[0].t_s
