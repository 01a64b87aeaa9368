"""What ought to be seen, if two views stand as verification says, and is not.

Two places that look alike share most points, but not all: what only one of them has is missing in the
other. Single points are missing anywhere (detectors miss them, things hide each other); where all points of
a patch of the image are missing, a *thing* is gone: a poster, a door, a box. In one pair of views even that
proves little, so this is evidence to be added up over many pairs, not a verdict. docs/places.md has its
distributions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from share.geometry import se3
from share.mapping.recognition.refinement import move
from share.mapping.recognition.verification import Sight
from share.types import F64, I64
from share.vision.matching import apart

_BESIDE_PX = 6.0  # a point is found if one as like as this lies beside where it should be
_THING_PX = 15.0  # a thing is still there if it has moved by this: the map may have drifted
_BITS = 90
_AROUND_PX = 40.0  # whose depth says whether something may hide the point
_MARGIN = 0.03  # of the image's sides; a detector finds nothing at its border
_HIDDEN, _HIDDEN_RHO = 1.2, 0.02  # share, and 1/m, by which all around is nearer than a hidden point
_THING_RAD = 0.1  # a patch of the image, so far around a point,
_THING_POINTS = 10  # in which so many ought to be seen: if none is, a thing is gone


class Missing(NamedTuple):
    """Points of both views that the other ought to show, and those of them that it does."""

    visible: int
    found: int

    @property
    def share(self) -> float:
        """Of the visible ones, that are not found; 0 if none is visible."""
        return 1 - self.found / self.visible if self.visible else 0.0


class Gone(NamedTuple):
    """Points of both views that the other ought to show, and those amid a patch of which it shows none."""

    visible: int
    gone: int

    @property
    def share(self) -> float:
        """0 if none is visible."""
        return self.gone / self.visible if self.visible else 0.0


def missing(query: Sight, candidate: Sight, T_c_q: F64) -> Missing:
    """With T_c_q (4, 4): the query's body in the candidate's body frame."""
    there, back = _both(query, candidate, T_c_q, _BESIDE_PX)
    return Missing(len(there.found) + len(back.found), int(there.found.sum() + back.found.sum()))


def gone(query: Sight, candidate: Sight, T_c_q: F64) -> Gone:
    """The same, of whole things: from about one spot, and within 1 m say little else is gone in a true pair.

    From further apart things hide each other that no keypoint tells of.
    """
    there, back = _both(query, candidate, T_c_q, _THING_PX)
    return Gone(len(there.found) + len(back.found), _amid_nothing(there) + _amid_nothing(back))


class _Seen(NamedTuple):
    """Points of one view that the other camera ought to see: where (N, 2), and whether it does (N,)."""

    uv: F64
    found: NDArray[np.bool_]


def _both(query: Sight, candidate: Sight, T_c_q: F64, reach_px: float) -> tuple[_Seen, _Seen]:
    T = se3.inverse(candidate.T_body_cam0) @ T_c_q @ query.T_body_cam0
    return _seen(T, query, candidate, reach_px), _seen(se3.inverse(T), candidate, query, reach_px)


def _seen(T: F64, source: Sight, target: Sight, reach_px: float) -> _Seen:
    y = target.y
    if not len(source.view) or not len(y):
        return _Seen(np.zeros((0, 2)), np.zeros(0, bool))
    moved = move(T, source.y.T).T
    inside = np.flatnonzero(_inside(moved, y))
    moved = moved[inside]
    rows, cols, px = _beside(target.focal * moved[:, :2], target.focal * y[:, :2])
    bits = apart(source.view.descriptors[inside[rows]], target.view.descriptors[cols])
    found = np.zeros(len(inside), bool)
    found[rows[(px < reach_px) & (bits <= _BITS)]] = True
    around = np.full(len(inside), np.inf)  # least inverse depth of those near it
    np.fmin.at(around, rows, y[cols, 2])
    visible = around <= _HIDDEN * moved[:, 2] + _HIDDEN_RHO
    return _Seen(moved[visible, :2], found[visible])


def _amid_nothing(seen: _Seen) -> int:
    """How many points are amid others of which none is found."""
    lost = seen.uv[~seen.found]
    alone = ~_within(lost, seen.uv[seen.found], _THING_RAD).any(1)
    amid = _within(lost[alone], lost, _THING_RAD).sum(1) >= _THING_POINTS
    return int(amid.sum())


def _within(a: F64, b: F64, reach: float) -> NDArray[np.bool_]:
    """Which of a (N, 2) and b (K, 2) lie nearer than reach to each other (N, K)."""
    square = (a[:, :1] - b[:, 0]) ** 2 + (a[:, 1:] - b[:, 1]) ** 2
    return np.asarray(square < reach**2)


def _inside(moved: F64, target: F64) -> NDArray[np.bool_]:
    """Within the part of the image where the target has keypoints; not if it has no image (NaN)."""
    low, high = target[:, :2].min(0), target[:, :2].max(0)
    margin = _MARGIN * (high - low)
    return np.asarray(((moved[:, :2] > low + margin) & (moved[:, :2] < high - margin)).all(1))


def _beside(a: F64, b: F64) -> tuple[I64, I64, F64]:
    """Which of a (N, 2) and b (K, 2) are near, pixels: rows, columns, distances (M,)."""
    found = KDTree(a).sparse_distance_matrix(KDTree(b), _AROUND_PX, output_type="ndarray")
    return found["i"], found["j"], found["v"]
