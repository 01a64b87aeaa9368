"""Corners to track: strong, and spread evenly over the image."""

from __future__ import annotations

import cv2
import numpy as np

from share.types import F32, U8


def detect(image: U8, taken: F32, count: int, spacing: float, quality: float = 0.005) -> F32:
    """Up to `count` new corners (N, 2) px, at least `spacing` px from each other and from `taken` (M, 2).

    Minimum-eigenvalue corners (Shi and Tomasi 1994), refined to a fraction of a pixel. The mask
    round `taken` makes new corners fill what the tracked ones leave empty.
    """
    if count <= 0:
        return np.zeros((0, 2), np.float32)
    mask = np.full(image.shape, 255, np.uint8)
    for x, y in np.rint(taken).astype(int):
        cv2.circle(mask, (int(x), int(y)), round(spacing), 0, -1)
    corners = cv2.goodFeaturesToTrack(image, count, quality, spacing, mask=mask, blockSize=5)
    if corners is None:
        return np.zeros((0, 2), np.float32)
    corners = np.ascontiguousarray(corners.reshape(-1, 1, 2), np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 10, 0.03)
    refined: F32 = cv2.cornerSubPix(image, corners, (3, 3), (-1, -1), criteria).reshape(-1, 2)
    return refined


def count(image: U8, contrast: int = 12) -> int:
    """How many FAST corners there are: whether there is anything to see."""
    return len(cv2.FastFeatureDetector.create(contrast).detect(image))
