"""Corners to track: strong, and spread evenly over the image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from share.types import F32, F64, I64, U8

_BLOCK_PX = 5  # px, of a corner
_MIN_EIGENVALUE = 4e-4  # of its least eigenvalue: above the noise of an image
_SUPPRESSION_PX = 9  # px, within which only the strongest counts
_BORDER_PX = 6  # px
_GRID = (8, 6)  # of the image


def detect(image: U8, occupied_px: F32, count: int, spacing: float, mask: U8 | None = None) -> F32:
    """Up to `count_fast` new corners (N, 2) px, at least `spacing` px from each other and from `occupied_px`
    (M, 2).
    within (H, W): a mask of where to look.

    Minimum-eigenvalue corners (Shi and Tomasi 1994), refined to a fraction of a pixel. Parts of the image
    that have few come first, so that no bright poster takes them all; `occupied_px` ones count.
    """
    if count <= 0:
        return np.zeros((0, 2), np.float32)
    px, strength = _peaks(image)
    if mask is not None:
        px, strength = _masked(px, strength, mask)
    order = spread_order(px, strength, image.shape[::-1], _GRID, occupied_px)
    chosen = _spaced(px[order], occupied_px, count, spacing, image.shape)
    if len(chosen) == 0:
        return np.zeros((0, 2), np.float32)
    return _refined(image, chosen)


def _masked(px: I64, strength: F32, mask: U8) -> tuple[I64, F32]:
    allowed = mask[px[:, 1], px[:, 0]] > 0
    return px[allowed], strength[allowed]


def strongest(
    image: U8, occupied_px: F32, count: int, spacing: float, quality: float = 0.005, mask: U8 | None = None
) -> F32:
    """As `detect`, wherever they are: those down to `quality` times the best. Few good ones are worth more
    than many where no IMU helps (0.5 cm less in the kitchen of docs/understand/odometry-without-imu.md)."""
    if count <= 0:
        return np.zeros((0, 2), np.float32)
    free = _free_mask(occupied_px, spacing, image.shape)
    if mask is not None:
        free &= mask
    found = cv2.goodFeaturesToTrack(image, count, quality, spacing, mask=free, blockSize=_BLOCK_PX)
    return np.zeros((0, 2), np.float32) if found is None else _refined(image, found)


def _refined(image: U8, px: NDArray[np.generic]) -> F32:
    """To a fraction of a pixel."""
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 10, 0.03)
    start = np.ascontiguousarray(px.reshape(-1, 1, 2), np.float32)
    out: F32 = cv2.cornerSubPix(image, start, (3, 3), (-1, -1), criteria).reshape(-1, 2)
    return out


def _peaks(image: U8) -> tuple[I64, F32]:
    """Corners (N, 2) px that are the strongest ones near, and how strong (N,)."""
    strength = cv2.cornerMinEigenVal(image, _BLOCK_PX)
    local_max = cv2.dilate(strength, np.ones((_SUPPRESSION_PX, _SUPPRESSION_PX), np.uint8))
    peak = (strength == local_max) & (strength > _MIN_EIGENVALUE)
    peak[:_BORDER_PX], peak[-_BORDER_PX:], peak[:, :_BORDER_PX], peak[:, -_BORDER_PX:] = (
        False,
        False,
        False,
        False,
    )
    found = cv2.findNonZero(peak.view(np.uint8))  # a fifth of the time of np.nonzero
    px = np.zeros((0, 2), np.int64) if found is None else found.reshape(-1, 2).astype(np.int64)
    return px, strength[px[:, 1], px[:, 0]]


def _spaced(px: I64, occupied_px: F32, count: int, spacing: float, shape: tuple[int, ...]) -> I64:
    """The first `count_fast` of px (N, 2), in order, that keep their distance."""
    free, chosen = _free_mask(occupied_px, spacing, shape), []
    for x, y in px.tolist():
        if free[y, x]:
            chosen.append((x, y))
            if len(chosen) == count:
                break
            cv2.circle(free, (x, y), round(spacing), 0, -1)
    return np.array(chosen, np.int64).reshape(-1, 2)


def _free_mask(occupied_px: F32, spacing: float, shape: tuple[int, ...]) -> U8:
    """A mask, 255 where there is room."""
    free = np.full(shape, 255, np.uint8)
    for x, y in np.rint(occupied_px).astype(int).tolist():
        cv2.circle(free, (x, y), round(spacing), 0, -1)
    return free


def count_fast(image: U8, contrast: int = 12) -> int:
    """How many FAST corners there are: whether there is anything to see."""
    return len(cv2.FastFeatureDetector.create(contrast).detect(image))


# ---- Points of an image by the cells of a grid over it.

Size = tuple[int, int]  # width, height


def cell_indices(px: F32 | F64 | I64, size: Size, grid: Size) -> I64:
    """The cell (N,), row by row, of each of px (N, 2) in an image of `size`."""
    at = (px * grid / size).astype(np.int64).clip(0, np.array(grid) - 1)
    out: I64 = at[:, 1] * grid[0] + at[:, 0]
    return out


def spread_order(
    px: F32 | I64, strength: F32 | F64, size: Size, grid: Size, occupied_px: F32 | None = None
) -> I64:
    """An order (N,): the strongest of each cell, then the second strongest, and so on; those that rank
    alike by strength. taken (M, 2): points that are there already rank first in their cells."""
    cell = cell_indices(px, size, grid)
    order = np.lexsort((-strength, cell))
    first = np.searchsorted(cell[order], np.arange(grid[0] * grid[1]))
    rank = np.arange(len(px)) - first[cell[order]]  # how many of its own cell are stronger
    if occupied_px is not None:
        rank = rank + np.bincount(cell_indices(occupied_px, size, grid), minlength=len(first))[cell[order]]
    out: I64 = order[np.lexsort((-strength[order], rank))]
    return out
