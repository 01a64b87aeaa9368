"""What the views of a target cover, what is missing, and which of many views to take.

Intrinsics are told by corners in all of the image, by boards that lean to each side (else focal length and
distance are one), and by near and far ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.calibration.bundle import View
from share.calibration.start import enough, homography
from share.geometry.target import Target
from share.types import F64, I64

GRID = (6, 8)  # rows and columns of cells in which corners are counted
_NAMES = (
    ("upper left corner", "upper edge", "upper right corner"),
    ("left edge", "middle", "right edge"),
    ("lower left corner", "lower edge", "lower right corner"),
)
_LEANT_DEG = 15.0
_SHAPE_WEIGHT = 3.0  # of how a board lies, in cells
_STRETCH_WEIGHT = 10.0  # of its stretch of the recording: neighbours are nearly copies, and err alike


@dataclass(frozen=True, eq=False)
class Coverage:
    """Of one camera and the V views that it sees. cells: corners in each cell of `GRID`; leans (V, 2): the
    board's lean about the image's y and x, rad; distances (V,): m."""

    cells: I64
    leans: F64
    distances: F64

    @property
    def share(self) -> float:
        """Of the cells that hold a corner."""
        return float((self.cells > 0).mean())

    @property
    def missing(self) -> tuple[str, ...]:
        """In words, what a person should show the camera."""
        regions = self.cells.reshape(3, 2, 8)
        columns = (slice(0, 2), slice(2, 6), slice(6, 8))
        empty = [
            _NAMES[row][k] for row in range(3) for k in range(3) if not regions[row][:, columns[k]].any()
        ]
        out = [f"no view reaches the image's {name}" for name in empty]
        limit = np.radians(_LEANT_DEG)
        for axis, (low, high) in enumerate((("left", "right"), ("top", "bottom"))):
            for name, leant in ((low, self.leans[:, axis] < -limit), (high, self.leans[:, axis] > limit)):
                if not leant.any():
                    out.append(f"no view with the board's {name} side {_LEANT_DEG:.0f} degrees nearer")
        if self.distances.max() < 1.3 * self.distances.min():
            out.append("all views are from one distance: go nearer and farther")
        return tuple(out)


def coverage(pixels: Sequence[F64], T_cam_target: F64, target: Target, size: tuple[int, int]) -> Coverage:
    """Of the corners (N, 2) px of each view, and its pose (V, 4, 4); what it does not see does not count."""
    T_cam_target = T_cam_target[[len(px) > 0 for px in pixels]]
    middle = np.append(target.extent.mean(axis=0), 0)
    at = T_cam_target[:, :3, :3] @ middle + T_cam_target[:, :3, 3]
    normal = -T_cam_target[:, :3, 2]  # away from who looks
    leans = np.arctan2(normal[:, :2], normal[:, 2:])
    cells = np.bincount(cells_of(np.concatenate(pixels), size), minlength=GRID[0] * GRID[1])
    return Coverage(cells.reshape(GRID), leans, np.linalg.norm(at, axis=1))


def cells_of(px: F64, size: tuple[int, int]) -> I64:
    """Number of the cell (N,) of each pixel (N, 2), along rows."""
    column, row = np.clip(px / size * GRID[::-1], 0, np.array(GRID[::-1]) - 1).astype(np.int64).T
    return np.asarray(row * GRID[1] + column, np.int64)


def choose(views: Sequence[View], target: Target, size: tuple[int, int], most: int) -> list[int]:
    """Which views, rising, at most `most`: one after another the one that adds most of what is still rare,
    cells of the image, ways a board lies in it, stretches of the recording (views are in its order)."""
    told = [_told(view, target, size) for view in views]
    for k, what in enumerate(told):
        if what:
            what["stretch", k * most // len(views)] = _STRETCH_WEIGHT
    met: dict[object, int] = {}
    chosen: list[int] = []
    left = [k for k, what in enumerate(told) if what]
    while left and len(chosen) < most:
        gains = [sum(weight / (1 + met.get(key, 0)) ** 2 for key, weight in told[k].items()) for k in left]
        best = left.pop(int(np.argmax(gains)))
        chosen.append(best)
        for key in told[best]:
            met[key] = met.get(key, 0) + 1
    return sorted(chosen)


def _told(view: View, target: Target, size: tuple[int, int]) -> dict[object, float]:
    """What a view has to say, with weights: cells, and classes of lean and size by its homography."""
    out: dict[object, float] = {}
    for eye, seen in enumerate(view.seen):
        board = target.corners[seen.ids, :2]
        if not enough(board):
            continue
        for cell in np.unique(cells_of(seen.px, size)).tolist():
            out[eye, "cell", cell] = 1.0
        H = homography(board, (seen.px - np.array(size) / 2) / max(size))
        H = H / H[2, 2]
        leant = np.clip(np.round(H[2, :2] / 0.25), -2, 2).astype(int)
        out[eye, "lean", *leant.tolist()] = _SHAPE_WEIGHT
        out[eye, "size", round(np.log2(abs(np.linalg.det(H[:2, :2]))))] = _SHAPE_WEIGHT
    return out
