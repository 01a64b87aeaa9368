"""Score of keyframe candidates under a rate limit: prefer places that are recognised more often."""

from __future__ import annotations

from collections import deque
from statistics import median

import numpy as np

from share.types import View

_WINDOW = 20  # recent candidates with which one is compared
_MAX_DEPTH_M = 20.0  # depth beyond which the score does not grow


def median_depth_m(view: View) -> float:
    """Return the median depth of a view's points, m; 0 without points.

    A view of distant structure overlaps with views from elsewhere; a close-up is recognised from the same
    spot only.
    """
    depth = view.points[:, 2]
    valid = depth[np.isfinite(depth)]
    return float(np.median(valid.clip(0.0, _MAX_DEPTH_M))) if valid.size else 0.0


class KeyframeScore:
    """Scores the candidates of one agent."""

    def __init__(self) -> None:
        self._recent_scores: deque[float] = deque(maxlen=_WINDOW)

    def is_above_median(self, view: View) -> bool:
        """Return whether the view scores at least the median of the recent ones, itself included."""
        score = median_depth_m(view)
        self._recent_scores.append(score)
        return score >= median(self._recent_scores)
