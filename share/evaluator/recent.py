"""What the last seconds were like, since the error of the last seconds is what is to be told.

A keyframe shows how well its tracker fares now; what was lost three seconds ago, in the dark, is still lost.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from share.evaluator.odometer import Lately
from share.evaluator.scalars import NAMES
from share.types import F32

RECENT = (*(f"{what} {name}" for what in ("mean", "least", "most") for name in NAMES), "way", "turn")
_FAR_M, _TURNED_RAD = 5.0, 5.0  # count as 1


class Recent:
    """Of one agent, keyframe by keyframe."""

    def __init__(self) -> None:
        self._seen: deque[tuple[int, F32]] = deque()  # stamp, its scalars

    def after(self, stamp_ns: int, scalars: F32, lately: Lately) -> F32:
        """(26,) as `RECENT`: mean, least and most of each of the scalars (8,) since `lately` began, and how
        far the body went and turned."""
        while self._seen and self._seen[0][0] < lately.since_ns:
            self._seen.popleft()
        self._seen.append((stamp_ns, scalars))
        seen = np.stack([scalars for _, scalars in self._seen])
        moved = np.array([lately.way_m / _FAR_M, lately.turn_rad / _TURNED_RAD], np.float32)
        return np.concatenate([seen.mean(axis=0), seen.min(axis=0), seen.max(axis=0), moved])
