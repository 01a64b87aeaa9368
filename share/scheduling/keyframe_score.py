"""Which keyframes to send where not all may be: those from which a place is found more likely than usual."""

from __future__ import annotations

from collections import deque
from statistics import median

import numpy as np

from share.types import View

_WINDOW = 20  # candidates, with which one is compared
_MAX_DEPTH_M = 20.0  # farther than this is no better


def median_depth_m(view: View) -> float:
    """Median distance of its points in front of the camera; 0 without points.

    Who sees far sees what others have seen too; a view of what is near is found again from there only.
    """
    depth = view.points[:, 2]
    valid = depth[np.isfinite(depth)]
    return float(np.median(valid.clip(0.0, _MAX_DEPTH_M))) if valid.size else 0.0


class KeyframeScore:
    """Of the candidates of one agent."""

    def __init__(self) -> None:
        self._recent_scores: deque[float] = deque(maxlen=_WINDOW)

    def is_above_median(self, view: View) -> bool:
        """Whether it is worth no less than half of those of late."""
        score = median_depth_m(view)
        self._recent_scores.append(score)
        return score >= median(self._recent_scores)
