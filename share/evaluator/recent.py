"""What the last seconds were like, since the error of the last seconds is what is to be told.

A keyframe shows how well its tracker fares now; what was lost three seconds ago, in the dark, is still lost.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from share.evaluator.odometer import Lately
from share.evaluator.scalars import NAMES
from share.types import F32

_SURPRISE = "surprise"
RECENT = (
    *(f"{what} {name}" for what in ("mean", "least", "most") for name in (*NAMES, _SURPRISE)),
    _SURPRISE,
    "way",
    "turn",
)
_FAR_M, _TURNED_RAD = 5.0, 5.0  # count as 1
_AMAZED = 100.0  # squared sigmas, the same


class Recent:
    """Of one agent, keyframe by keyframe."""

    def __init__(self) -> None:
        self._seen: deque[tuple[int, F32]] = deque()  # stamp, its scalars and its surprise

    def after(self, stamp_ns: int, scalars: F32, surprise: float, lately: Lately) -> F32:
        """(30,) as `RECENT`: mean, least and most of each of the scalars (8,) and of the surprise (`Footing`)
        since `lately` began, the surprise now, and how far the body went and turned."""
        while self._seen and self._seen[0][0] < lately.since_ns:
            self._seen.popleft()
        now = math.log1p(surprise) / math.log1p(_AMAZED)
        self._seen.append((stamp_ns, np.append(scalars, np.float32(now))))
        seen = np.stack([row for _, row in self._seen])
        more = np.array([now, lately.way_m / _FAR_M, lately.turn_rad / _TURNED_RAD], np.float32)
        return np.concatenate([seen.mean(axis=0), seen.min(axis=0), seen.max(axis=0), more])
