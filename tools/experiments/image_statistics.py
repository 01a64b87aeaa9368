"""Statistics of an image that matter to a tracker: corners, their distribution, contrast."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from share.types import F64, U8

GRID = 8  # cells along each side
WIDTH, HEIGHT = 640, 480  # size for which all figures hold


@dataclass(frozen=True)
class ImageStatistics:
    """fast: FAST corners at threshold 20. gftt: Shi-Tomasi corners at quality 0.01, 10 px apart. cells: share
    of an 8 x 8 grid of cells with a FAST corner. slope: a of the amplitude spectrum 1 / f^a. mean, p5, p95:
    gray levels. sharpness: median size of the gray-level gradient, levels per pixel."""

    fast: float
    gftt: float
    cells: float
    slope: float
    mean: float
    p5: float
    p95: float
    sharpness: float


def image_statistics(image: U8) -> ImageStatistics:
    """Return the statistics of an image (480, 640) uint8. Raises ValueError for another shape: counts would
    not compare."""
    import cv2

    if image.shape != (HEIGHT, WIDTH):
        raise ValueError(f"image: shape {image.shape}, expected {(HEIGHT, WIDTH)}")
    fast_corners = cv2.FastFeatureDetector.create(20).detect(image)
    corner_px = np.array([k.pt for k in fast_corners]).reshape(-1, 2)
    corners = cv2.goodFeaturesToTrack(image, 0, 0.01, 10)
    gx, gy = (cv2.Sobel(image, cv2.CV_32F, *d, scale=1 / 8) for d in ((1, 0), (0, 1)))
    p5, p95 = np.percentile(image, (5, 95))
    return ImageStatistics(
        fast=len(fast_corners),
        gftt=0 if corners is None else len(corners),
        cells=_occupied_cells(corner_px),
        slope=spectrum_slope(image),
        mean=float(image.mean()),
        p5=float(p5),
        p95=float(p95),
        sharpness=float(np.median(np.hypot(gx, gy))),
    )


def mean_statistics(images: Sequence[U8]) -> ImageStatistics:
    """Return the mean over the images."""
    return ImageStatistics(*np.mean([astuple(image_statistics(image)) for image in images], axis=0).tolist())


def spectrum_slope(image: U8) -> float:
    """Return a of the amplitude spectrum 1 / f^a between 1/64 and 1/4 cycle per pixel, from the middle square
    under a Hann window, averaged over directions (van der Schaaf & van Hateren, Vision Res. 36, 1996)."""
    n = min(image.shape)
    top, left = ((s - n) // 2 for s in image.shape)
    window = np.hanning(n)
    square = image[top : top + n, left : left + n].astype(float)
    amplitude = np.abs(np.fft.rfft2((square - square.mean()) * np.outer(window, window)))
    f = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None])
    edges = np.geomspace(1 / 64, 1 / 4, 13)
    band = np.digitize(f, edges) - 1
    means = [amplitude[band == k].mean() for k in range(12)]
    return float(-np.polyfit(np.log(edges[:-1]), np.log(np.maximum(means, 1e-9)), 1)[0])


def resize_to_standard(image: U8) -> U8:
    """Return the middle 4:3 of an image, shrunk to 640 x 480 by areas; an image of that height is only
    cropped."""
    import cv2

    h, w = image.shape
    wide, high = min(w, h * 4 // 3), min(h, w * 3 // 4)
    top, left = (h - high) // 2, (w - wide) // 2
    middle = image[top : top + high, left : left + wide]
    if middle.shape == (HEIGHT, WIDTH):
        return middle
    return np.asarray(cv2.resize(middle, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), np.uint8)


def _occupied_cells(corner_px: F64) -> float:
    cell = (corner_px / (WIDTH / GRID, HEIGHT / GRID)).astype(int)
    return len(np.unique(cell, axis=0)) / GRID**2 if len(corner_px) else 0.0
