"""Detect corners to track: strong, spread evenly, and within the used part of a wide lens's image."""

from __future__ import annotations

import itertools
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import Camera
from share.geometry.lens import MAX_FIELD_DEG
from share.types import F32, F64, I64, U8

_BLOCK_PX = 5
_MIN_EIGENVALUE = 4e-4  # above the noise of an image
_SUPPRESSION_PX = 9  # window in which only the strongest corner is kept
_BORDER_PX = 6
_BANDS = 4
_BAND_MARGIN_PX = 8  # rows beyond a band on which its corners depend
_FAST_CONTRAST = 12
_STRONGEST_QUALITY = 0.005  # of the best corner
GRID = (8, 6)  # cells across and down, over which features are spread


def detect(
    image: U8,
    occupied_px: F32,
    count: int,
    spacing: float,
    mask: U8 | None = None,
    peaks: CornerPeaks | None = None,
) -> F32:
    """Return up to `count` new corners (N, 2) px, at least `spacing` px from each other and from occupied_px
    (M, 2).

    mask (H, W): 255 where corners may be. peaks: of this image, if some are known. Minimum-eigenvalue corners
    (Shi and Tomasi 1994), with subpixel refinement. Cells with few points come first, so that a poster does
    not take all corners; those in `occupied_px` count.
    """
    if count <= 0:
        return np.zeros((0, 2), np.float32)
    px, strength = (peaks or CornerPeaks(image)).px_and_strength()
    if mask is not None:
        px, strength = _masked(px, strength, mask)
    order = spread_order(px, strength, image.shape[::-1], GRID, occupied_px)
    chosen = _spaced(px[order], occupied_px, count, spacing, image.shape)
    if len(chosen) == 0:
        return np.zeros((0, 2), np.float32)
    return _refined(image, chosen)


def _masked(px: I64, strength: F32, mask: U8) -> tuple[I64, F32]:
    allowed = mask[px[:, 1], px[:, 0]] > 0
    return px[allowed], strength[allowed]


def strongest(image: U8, occupied_px: F32, count: int, spacing: float, mask: U8 | None = None) -> F32:
    """Return corners as `detect` does, but not spread: those down to `_STRONGEST_QUALITY` times the best.

    Without an IMU a few good corners are better than many (0.5 cm less in the kitchen of
    docs/understand/odometry-without-imu.md).
    """
    if count <= 0:
        return np.zeros((0, 2), np.float32)
    free = _free_mask(occupied_px, spacing, image.shape)
    if mask is not None:
        free &= mask
    found = cv2.goodFeaturesToTrack(image, count, _STRONGEST_QUALITY, spacing, mask=free, blockSize=_BLOCK_PX)
    return np.zeros((0, 2), np.float32) if found is None else _refined(image, found)


def _refined(image: U8, px: NDArray[np.generic]) -> F32:
    """Return the corners (N, 2) px with subpixel refinement."""
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 10, 0.03)
    start = np.ascontiguousarray(px.reshape(-1, 1, 2), np.float32)
    out: F32 = cv2.cornerSubPix(image, start, (3, 3), (-1, -1), criteria).reshape(-1, 2)
    return out


class CornerPeaks:
    """Corners of an image that are local maxima of their strength. They are found in bands of rows, which the
    processor's cache can hold."""

    def __init__(self, image: U8) -> None:
        bounds = np.linspace(0, len(image), _BANDS + 1).astype(int).tolist()
        self._image, self._bands = image, list(itertools.pairwise(bounds))
        self._found: list[tuple[I64, F32]] = []

    def find_half(self) -> None:
        """Find those of half of the image, if they are not all found."""
        for _ in range(_BANDS // 2):
            if self._bands:
                self._found.append(_peaks(self._image, *self._bands.pop(0)))

    def px_and_strength(self) -> tuple[I64, F32]:
        """Return px (N, 2), row by row, and strength (N,) in the whole image."""
        while self._bands:
            self.find_half()
        px, strength = zip(*self._found, strict=True)
        return np.concatenate(px), np.concatenate(strength)


def _peaks(image: U8, first: int, end: int) -> tuple[I64, F32]:
    """Return corners (N, 2) px in rows [first, end) that are local maxima, and their strength (N,)."""
    above, below = max(first - _BAND_MARGIN_PX, 0), min(end + _BAND_MARGIN_PX, len(image))
    strength = cv2.cornerMinEigenVal(image[above:below], _BLOCK_PX)
    local_max = cv2.dilate(strength, np.ones((_SUPPRESSION_PX, _SUPPRESSION_PX), np.uint8))
    rows = slice(max(first, _BORDER_PX) - above, min(end, len(image) - _BORDER_PX) - above)
    inside = rows, slice(_BORDER_PX, image.shape[1] - _BORDER_PX)
    strength, local_max = strength[inside], local_max[inside]
    is_peak = (strength == local_max) & (strength > _MIN_EIGENVALUE)
    y, x = np.divmod(np.flatnonzero(is_peak), max(strength.shape[1], 1))  # faster than np.nonzero
    return np.column_stack([x + _BORDER_PX, y + (rows.start + above)]), strength[y, x]


def _spaced(px: I64, occupied_px: F32, count: int, spacing: float, shape: tuple[int, ...]) -> I64:
    """Return the first `count` of px (N, 2), in order, that keep their distance."""
    free, chosen = _free_mask(occupied_px, spacing, shape), []
    for x, y in px.tolist():
        if free[y, x]:
            chosen.append((x, y))
            if len(chosen) == count:
                break
            cv2.circle(free, (x, y), round(spacing), 0, -1)
    return np.array(chosen, np.int64).reshape(-1, 2)


def _free_mask(occupied_px: F32, spacing: float, shape: tuple[int, ...]) -> U8:
    """Return a mask, 255 where a new corner keeps its distance."""
    free = np.full(shape, 255, np.uint8)
    for x, y in np.rint(occupied_px).astype(int).tolist():
        cv2.circle(free, (x, y), round(spacing), 0, -1)
    return free


def count_fast(image: U8) -> int:
    """Return the number of FAST corners: whether the image has texture."""
    return len(cv2.FastFeatureDetector.create(_FAST_CONTRAST).detect(image))


Size = tuple[int, int]  # width, height; or cells across and down


def cell_indices(px: F32 | F64 | I64, size: Size, grid: Size) -> I64:
    """Return the cell (N,), row by row, of each of px (N, 2) in an image of `size`."""
    at = (px * grid / size).astype(np.int64).clip(0, np.array(grid) - 1)
    out: I64 = at[:, 1] * grid[0] + at[:, 0]
    return out


def spread_order(
    px: F32 | I64, strength: F32 | F64, size: Size, grid: Size, occupied_px: F32 | None = None
) -> I64:
    """Return an order (N,): the strongest of each cell, then the second strongest of each, and so on; equal
    ranks by strength.

    occupied_px (M, 2): existing points, which rank first in their cells.
    """
    cell = cell_indices(px, size, grid)
    order = np.lexsort((-strength, cell))
    first = np.searchsorted(cell[order], np.arange(grid[0] * grid[1]))
    rank = np.arange(len(px)) - first[cell[order]]  # number of stronger points in its cell
    if occupied_px is not None:
        rank = rank + np.bincount(cell_indices(occupied_px, size, grid), minlength=len(first))[cell[order]]
    out: I64 = order[np.lexsort((-strength[order], rank))]
    return out


# ---- The used part of an image

# Limit for views and for a tracker without an IMU, which weigh all points alike: here a pixel is four times
# as large in (x/z, y/z) as on the axis.
UNIFORM_FIELD_DEG = 60.0
_MASK_SIDE_PX = 1000


@lru_cache(maxsize=8)
def field_mask(camera: Camera, max_deg: float = MAX_FIELD_DEG) -> U8 | None:
    """Return a mask (H, W), 255 within `max_deg` of the axis and the range of the lens; None, for all, of
    an unbounded lens."""
    if not camera.is_bounded:
        return None
    step = 1 + max(camera.width, camera.height) // _MASK_SIDE_PX  # large images: computed on a grid
    px = np.stack(np.meshgrid(np.arange(0, camera.width, step), np.arange(0, camera.height, step)), axis=-1)
    uv = camera.normalise(px.astype(np.float64))
    radius = np.hypot(uv[..., 0], uv[..., 1])
    mask = np.where(radius < np.tan(np.radians(max_deg)), 255, 0).astype(np.uint8)
    if step == 1:
        return mask
    size = camera.width, camera.height
    return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), np.uint8)
