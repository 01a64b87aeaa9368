"""Which keyframes to send where not all may be: those from which a place is found more likely than usual."""

from __future__ import annotations

from collections import deque
from statistics import median

import numpy as np

from share.types import View

_RECENT = 20  # candidates, with which one is compared
_REACH_M = 20.0  # farther than this is no better


def reach_m(view: View) -> float:
    """Median distance of its points in front of the camera; 0 without points.

    Who sees far sees what others have seen too; a view of what is near is found again from there only.
    """
    depth = view.points[:, 2]
    known = depth[np.isfinite(depth)]
    return float(np.median(known.clip(0.0, _REACH_M))) if known.size else 0.0


class Worth:
    """Of the candidates of one agent."""

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=_RECENT)

    def is_rather_high(self, view: View) -> bool:
        """Whether it is worth no less than half of those of late."""
        worth = reach_m(view)
        self._recent.append(worth)
        return worth >= median(self._recent)
