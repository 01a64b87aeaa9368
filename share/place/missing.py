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
from share.place.matching import hamming
from share.place.refine import move
from share.place.verify import Sight
from share.types import F64

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
    bits = hamming(query.view.descriptors, candidate.view.descriptors)
    there = _seen(T, query.y, candidate.y, bits, candidate.focal)
    back = _seen(se3.inverse(T), candidate.y, query.y, bits.T, query.focal)
    return Missing(len(there) + len(back), int(there.sum() + back.sum()))


def _seen(T: F64, source: F64, target: F64, bits: NDArray[np.uint16], focal: float) -> NDArray[np.bool_]:
    """Of each source point that the target camera ought to see, whether it does."""
    if not len(source) or not len(target):
        return np.zeros(0, bool)
    moved = move(T, source)
    inside = np.flatnonzero(_inside(moved, target))
    moved = moved[inside]
    px = focal * np.linalg.norm(moved[:, None, :2] - target[None, :, :2], axis=2)
    found = ((px < _BESIDE_PX) & (bits[inside] <= _BITS)).any(1)
    return np.asarray(found[_open(moved[:, 2], px, target[:, 2])])


def _inside(moved: F64, target: F64) -> NDArray[np.bool_]:
    """Within the part of the image where the target has keypoints; not if it has no image (NaN)."""
    low, high = target[:, :2].min(0), target[:, :2].max(0)
    margin = _MARGIN * (high - low)
    return np.asarray(((moved[:, :2] > low + margin) & (moved[:, :2] < high - margin)).all(1))


def _open(rho: F64, px: F64, rho_target: F64) -> NDArray[np.bool_]:
    """Whether something around it is known that is as far, so that nothing need hide it."""
    around = np.where((px < _AROUND_PX) & np.isfinite(rho_target), rho_target, np.inf)
    return np.asarray(around.min(1, initial=np.inf) <= _HIDDEN * rho + _HIDDEN_RHO)
