"""What ought to be seen, if two views stand as verification says, and is not.

Two places that look alike share most points, but not all: what only one of them has is missing in the
other. In one pair of views that proves nothing (detectors miss points, things hide each other), so
this is evidence to be added up over many pairs, not a verdict. docs/places.md has its distributions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.place.matching import apart
from share.place.refine import move
from share.place.verify import Sight
from share.types import F64, I64

_BESIDE_PX = 6.0  # a point is found if one as like as this lies beside where it should be
_BITS = 90
_AROUND_PX = 40.0  # whose depth says whether something may hide the point
_MARGIN = 0.03  # of the image's sides; a detector finds nothing at its border
_HIDDEN, _HIDDEN_RHO = 1.2, 0.02  # share, and 1/m, by which all around is nearer than a hidden point


class Missing(NamedTuple):
    """Points of both views that the other ought to show, and those of them that it does."""

    visible: int
    found: int

    @property
    def share(self) -> float:
        """Of the visible ones, that are not found; 0 if none is visible."""
        return 1 - self.found / self.visible if self.visible else 0.0


def missing(query: Sight, candidate: Sight, T_c_q: F64) -> Missing:
    """With T_c_q (4, 4): the query's body in the candidate's body frame."""
    T = se3.inverse(candidate.T_body_cam0) @ T_c_q @ query.T_body_cam0
    there = _seen(T, query, candidate)
    back = _seen(se3.inverse(T), candidate, query)
    return Missing(len(there) + len(back), int(there.sum() + back.sum()))


def _seen(T: F64, source: Sight, target: Sight) -> NDArray[np.bool_]:
    """Of each source point that the target camera ought to see, whether it does."""
    y = target.y
    if not len(source.view) or not len(y):
        return np.zeros(0, bool)
    moved = move(T, source.y)
    inside = np.flatnonzero(_inside(moved, y))
    moved = moved[inside]
    rows, cols, px = _beside(target.focal * moved[:, :2], target.focal * y[:, :2])
    bits = apart(source.view.descriptors[inside[rows]], target.view.descriptors[cols])
    found = np.zeros(len(inside), bool)
    found[rows[(px < _BESIDE_PX) & (bits <= _BITS)]] = True
    around = np.full(len(inside), np.inf)  # least inverse depth of those near it
    np.fmin.at(around, rows, y[cols, 2])
    hides_nothing = around <= _HIDDEN * moved[:, 2] + _HIDDEN_RHO
    return np.asarray(found[hides_nothing])


def _inside(moved: F64, target: F64) -> NDArray[np.bool_]:
    """Within the part of the image where the target has keypoints; not if it has no image (NaN)."""
    low, high = target[:, :2].min(0), target[:, :2].max(0)
    margin = _MARGIN * (high - low)
    return np.asarray(((moved[:, :2] > low + margin) & (moved[:, :2] < high - margin)).all(1))


def _beside(a: F64, b: F64) -> tuple[I64, I64, F64]:
    """Which of a (N, 2) and b (K, 2) are near, pixels: rows, columns, distances (M,)."""
    square = (a[:, :1] - b[:, 0]) ** 2
    square += (a[:, 1:] - b[:, 1]) ** 2
    at = np.flatnonzero(square < _AROUND_PX**2)
    rows, cols = np.divmod(at, len(b))
    return rows, cols, np.sqrt(square.ravel()[at])
