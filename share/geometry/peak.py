"""Subsample peak of a sampled curve."""

from __future__ import annotations

import numpy as np

from share.types import F64


def subsample_peak(score: F64, i: int) -> float:
    """Return the peak of the parabola through score[i - 1 : i + 2], in steps from i, at most half a step;
    0 at an end of the curve and where it is not concave."""
    if not 0 < i < len(score) - 1:
        return 0.0
    left, middle, right = score[i - 1 : i + 2]
    bend = left - 2 * middle + right
    return float(np.clip((left - right) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0
