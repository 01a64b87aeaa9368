"""Track points from one image to another by their patches (Lucas and Kanade 1981; pyramid: Bouguet 2000)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from share.types import F32, U8
from share.vision.patches import sample_square

_NCC_HALF_PX = 5  # of the compared patches, 11 x 11
_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01)


def track_points(
    source: U8,
    target: U8,
    px: F32,
    guess: F32,
    window: int = 21,
    levels: int = 3,
    back_check_px: float | None = 0.5,
) -> tuple[F32, NDArray[np.bool_]]:
    """Return the positions in `target` of the patches round px (N, 2) of `source`, and which were found.

    guess (N, 2): initial positions. A point is found if it is inside the image and tracking it back ends
    within `back_check_px` of its start; None: no such check.
    """
    if len(px) == 0:
        return guess.copy(), np.zeros(0, bool)
    forward, ok = _lucas_kanade(source, target, px, guess, window, levels)
    height, width = target.shape
    found = ok
    if back_check_px is not None:
        # The initial position is the right one, so one level is enough.
        back, ok_back = _lucas_kanade(target, source, forward, px, window, 0)
        found = ok & ok_back & (np.linalg.norm(back - px, axis=1) <= back_check_px)
    found &= ((forward >= 1) & (forward <= (width - 2, height - 2))).all(axis=1)
    return forward, found


def _lucas_kanade(
    source: U8, target: U8, px: F32, guess: F32, window: int, levels: int
) -> tuple[F32, NDArray[np.bool_]]:
    start = np.array(guess, np.float32).reshape(-1, 1, 2)  # a copy: OpenCV writes into it
    out, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        np.ascontiguousarray(px, np.float32).reshape(-1, 1, 2),
        start,
        winSize=(window, window),
        maxLevel=levels,
        criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(out, np.float32).reshape(-1, 2), status.ravel() > 0


def ncc(source: U8, target: U8, px: F32, found_px: F32) -> F32:
    """Return the normalised cross-correlation (N,) of patches about px and found_px (N, 2): 1 if equal up to
    gain and bias."""
    if len(px) == 0:
        return np.zeros(0, np.float32)
    a, b = sample_square(source, px, _NCC_HALF_PX), sample_square(target, found_px, _NCC_HALF_PX)
    a = a - a.mean(axis=1, keepdims=True)
    b = b - b.mean(axis=1, keepdims=True)
    scale = np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1))
    out: F32 = (a * b).sum(axis=1) / np.maximum(scale, 1e-6)
    return out
