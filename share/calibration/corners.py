"""What residuals of corners (N, 2) px say: how much they scatter, and which were found wrongly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from share.types import F64

LEAST_SPREAD = 0.01  # px: below this corners are not found, whatever the residuals say
_KEPT = 5.0  # sigmas beyond which a corner counts as found wrongly
_MANY = 15  # corners, left out more than kept, tell where a lens is no longer of its model


def spread(residuals: F64) -> float:
    """Of one coordinate, px, by the median distance: 1.1774 sigma of two normal ones."""
    return max(float(np.median(np.linalg.norm(residuals, axis=1))) / 1.1774, LEAST_SPREAD)


def kept(residuals: F64, sigma_px: float) -> NDArray[np.bool_]:
    """Which (N,) are of corners that were not found wrongly. sigma_px: of one coordinate."""
    return np.asarray(np.linalg.norm(residuals, axis=1) <= _KEPT * sigma_px)


def lost(residuals: F64, sigma_px: float, least_px: float) -> int:
    """How many are beyond what is kept and beyond `least_px`: near the camera corners are found so well that
    those of a board far away look wrong beside them, and are none the worse."""
    far = np.linalg.norm(residuals, axis=1) > least_px
    return int((far & ~kept(residuals, sigma_px)).sum())


def rms(residuals: F64) -> float:
    """Of the distances, px; NaN of none."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean())) if len(residuals) else float("nan")


def reach(px: F64, centre: F64, kept: NDArray[np.bool_]) -> float | None:
    """px from the `centre` (2,) beyond which corners (N, 2) px were mostly not kept (N,): there the lens is
    not of its model. The place at which those that were not outnumber the others most; None where by few."""
    away = np.linalg.norm(px - centre, axis=1)
    outwards = np.argsort(-away, kind="stable")
    more = np.cumsum(np.where(kept[outwards], -1, 1))  # left out than kept, beyond each
    edge = int(more.argmax()) if len(more) else 0
    return float(away[outwards[edge]]) if len(more) and more[edge] >= _MANY else None
