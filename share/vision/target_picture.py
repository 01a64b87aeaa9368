"""What is printed on a calibration target, as black rectangles, and gray pictures of it.

Everything on a target is a rectangle along its axes, so a picture is exact: each texel is the share of
it that is black, and that is a product of two overlaps.
"""

from __future__ import annotations

import cv2
import numpy as np

from share.geometry.target import AprilGrid, CharucoBoard, Target
from share.types import F64

_BORDER = {AprilGrid: 2, CharucoBoard: 1}  # cells around a marker's bits


def ink(target: Target) -> F64:
    """Black rectangles (M, 4) m: x0, y0, x1, y1 in the target's frame. None overlap."""
    if isinstance(target, AprilGrid):
        return np.concatenate([_tags(target), _joints(target)])
    black = target.black
    inset = (target.square - target.marker) / 2
    markers = [_printed(cells, low + inset, target.marker) for cells, low in _markers(target)]
    return np.concatenate([np.hstack([black, black + target.square]), *markers])


def darkness(rectangles: F64, xs: F64, ys: F64) -> F64:
    """Share of each texel that is black, (H, W) 0..1. rectangles: `ink`. xs (W + 1,), rising, and ys
    (H + 1,), falling: borders between texels, m, so that row 0 is the top."""
    across = _overlap(rectangles[:, 0], rectangles[:, 2], xs)
    down = _overlap(rectangles[:, 1], rectangles[:, 3], ys[::-1])[:, ::-1]
    out: F64 = down.T @ across
    return out


def _overlap(low: F64, high: F64, borders: F64) -> F64:
    """Share of each interval between `borders` (N + 1,) that low..high (M,) covers, (M, N)."""
    reach = np.minimum(high[:, None], borders[1:]) - np.maximum(low[:, None], borders[:-1])
    share: F64 = np.maximum(reach, 0) / np.diff(borders)
    return share


def _tags(grid: AprilGrid) -> F64:
    return np.concatenate([_printed(cells, low, grid.tag_size) for cells, low in _markers(grid)])


def _joints(grid: AprilGrid) -> F64:
    """The black squares at the tags' corners."""
    row, column = np.divmod(np.arange((grid.rows + 1) * (grid.cols + 1)), grid.cols + 1)
    low = np.stack([column, row], axis=1) * (grid.tag_size + grid.gap) - grid.gap
    return np.hstack([low, low + grid.gap])


def _markers(target: Target) -> list[tuple[np.ndarray, F64]]:
    """Of each marker the cells (n, n), True for black, row 0 on top, and its lower left corner (2,) m,
    or that of its square."""
    april = isinstance(target, AprilGrid)
    name = "DICT_APRILTAG_36h11" if isinstance(target, AprilGrid) else target.dictionary
    found = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    border = _BORDER[type(target)]
    n = found.markerSize + 2 * border
    places = target.tags if isinstance(target, AprilGrid) else target.marked
    out = []
    for number, low in enumerate(places):
        cells = cv2.aruco.generateImageMarker(found, number, n, borderBits=border) < 128
        out.append((np.rot90(cells, 2) if april else cells, low))  # Kalibr's tags stand on their heads
    return out


def _printed(cells: np.ndarray, low: F64, size: float) -> F64:
    """Black rectangles (K, 4) m of a marker of `size` m: one for each run of black cells in a row."""
    n, out = len(cells), []
    for row, line in enumerate(cells):
        steps = np.flatnonzero(np.diff(np.pad(line.astype(int), 1)))
        out += [(a, n - 1 - row, b, n - row) for a, b in steps.reshape(-1, 2)]
    return np.tile(low, 2) + np.array(out) * (size / n)
