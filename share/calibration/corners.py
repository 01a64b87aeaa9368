"""What residuals of corners (N, 2) px say: how much they scatter, and which were found wrongly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from share.types import F64

LEAST_SPREAD = 0.01  # px: below this corners are not found, whatever the residuals say
_KEPT = 5.0  # sigmas beyond which a corner counts as found wrongly


def spread(residuals: F64) -> float:
    """Of one coordinate, px, by the median distance: 1.1774 sigma of two normal ones."""
    return max(float(np.median(np.linalg.norm(residuals, axis=1))) / 1.1774, LEAST_SPREAD)


def kept(residuals: F64, sigma_px: float) -> NDArray[np.bool_]:
    """Which (N,) are of corners that were not found wrongly. sigma_px: of one coordinate."""
    return np.asarray(np.linalg.norm(residuals, axis=1) <= _KEPT * sigma_px)


def rms(residuals: F64) -> float:
    """Of the distances, px; NaN of none."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean())) if len(residuals) else float("nan")
