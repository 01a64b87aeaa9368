"""Where in the image there is something to hold on to: the point spatial distribution (PSD).

A grid over cam0's image with three channels: how strong a corner each cell has, how many features there the
pose rests on, and how near they are. Source: SHARE, IMWUT 10(3) 97, 2026; scales: docs/error-model.md.
"""

from __future__ import annotations

import cv2
import numpy as np

from share.types import F32, U8, Footing
from share.vision.grid import cells

GRID = (16, 12)  # cells across and down, whatever the camera
CHANNELS = 3
CELL_PX = 20  # in the image in which corners are sought
_BLOCK = 3  # px, of a corner there
_WEAKEST, _DECADES = 1e-5, 4.0  # of a corner's least eigenvalue: 0, and what makes 1
_MANY = 4  # features in a cell that count as 1
_NEAREST_M = 0.5  # counts as 1


def psd(small: U8, footing: Footing, size: tuple[int, int]) -> F32:
    """(3, 12, 16): strength of the strongest corner, features that were believed, their mean inverse depth;
    all from 0, for nothing, to 1.

    small (240, 320): the image, scaled so that a cell has `CELL_PX`; size: width and height that it had, in
    which footing is.
    """
    count = GRID[0] * GRID[1]
    px, inverse = footing.px[footing.believed], 1 / footing.depth[footing.believed]
    cell, known = cells(px, size, GRID), np.isfinite(inverse)
    believed = np.bincount(cell, minlength=count)
    total = np.bincount(cell[known], inverse[known].clip(0, 1 / _NEAREST_M), count)
    near = total / np.maximum(np.bincount(cell[known], minlength=count), 1)
    shape = (GRID[1], GRID[0])
    return np.stack(
        [
            _strength(small),
            np.minimum(believed / _MANY, 1).reshape(shape).astype(np.float32),
            (near * _NEAREST_M).reshape(shape).astype(np.float32),
        ]
    )


def _strength(small: U8) -> F32:
    """(12, 16), by the logarithm of the least eigenvalue (Shi and Tomasi 1994)."""
    least = cv2.cornerMinEigenVal(small, _BLOCK)
    best = least.reshape(GRID[1], CELL_PX, GRID[0], CELL_PX).max(axis=(1, 3))
    out: F32 = (np.log10(np.maximum(best, _WEAKEST) / _WEAKEST) / _DECADES).clip(0, 1).astype(np.float32)
    return out
