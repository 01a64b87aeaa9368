"""Corners where four fields meet, two dark and two bright: saddles of brightness."""

from __future__ import annotations

import cv2
import numpy as np

from share.types import F64, I64, U8

_LEAST_PX = 2  # half a window below this refines nothing
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
_AROUND = 16  # places on a circle, an even number


def refined(image: U8, px: np.ndarray, halves: I64) -> F64:
    """Corners (N, 2) moved to the saddle in a window of 2 half + 1; NaN where it leaves its window or the
    image, or is too small."""
    room = np.array(image.shape[::-1]) - 1 - halves[:, None]
    fit = ((px >= halves[:, None]) & (px <= room)).all(axis=1) & (halves >= _LEAST_PX)
    out = np.full((len(px), 2), np.nan)
    for half in np.unique(halves[fit]).tolist():
        here = fit & (halves == half)
        start = np.ascontiguousarray(px[here], np.float32)
        moved = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), _STOP).reshape(-1, 2)
        step = np.linalg.norm(moved - start, axis=1)
        good = (step > 0) & (step < half)  # OpenCV gives the start itself where it would go too far
        out[here] = np.where(good[:, None], moved, np.nan)
    return out


def is_saddle(image: U8, px: F64, radii: I64) -> np.ndarray:
    """Which (N,) of corners (N, 2) look the same when turned by half a turn, by brightness on circles of
    `radii` (N,) px: a saddle does, in any perspective; the corner of one dark field does not. No NaN does."""
    out, known = np.zeros(len(px), bool), np.isfinite(px).all(axis=1)
    if not known.any():
        return out
    angle = 2 * np.pi / _AROUND * np.arange(_AROUND)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    x, y = (px[known, None] + radii[known, None, None] * circle).astype(np.float32).transpose(2, 0, 1)
    seen = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)
    opposite = np.roll(seen, _AROUND // 2, axis=1)
    alike = (seen + opposite) / 2
    even = ((alike - alike.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
    odd = ((seen - opposite) ** 2).sum(axis=1) / 4
    out[known] = odd < even
    return out
