"""What ought to be seen, if two views stand as verification says, and is not.

Two places that look alike share most points, but not all: what only one of them has is missing in the
other. Single points are missing anywhere (detectors miss them, things hide each other); where all points of
a patch of the image are missing, a *thing* is gone: a poster, a door, a box. In one pair of views even that
proves little, so this is evidence to be added up over many pairs, not a verdict. Distributions:
docs/understand/place-recognition.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from share.geometry import se3
from share.mapping.recognition.refinement import transfer_keypoints
from share.mapping.recognition.verification import CameraView
from share.types import F64, I64
from share.vision.matching import hamming_rowwise

_FOUND_PX = 6.0  # a point is found if one as like as this lies beside where it should be
_REGION_FOUND_PX = 15.0  # a thing is still there if it has moved by this: the map may have drifted
_MAX_BITS = 90
_OCCLUDER_PX = 40.0  # whose depth says whether something may hide the point
_BORDER_SHARE = 0.03  # of the image's sides; a detector finds nothing at its border
_OCCLUSION_RATIO, _OCCLUSION_RHO = (
    1.2,
    0.02,
)  # share, and 1/m, by which all around is nearer than a hidden point
_REGION_RAD = 0.1  # a patch of the image, so far around a point,
_MIN_REGION_POINTS = 10  # in which so many ought to be seen: if none is, a thing is gone


class MissingPoints(NamedTuple):
    """Points of both views that the other ought to show, and those of them that it does."""

    visible: int
    found: int

    @property
    def missing_share(self) -> float:
        """Of the visible ones, that are not found; 0 if none is visible."""
        return 1 - self.found / self.visible if self.visible else 0.0


class MissingRegions(NamedTuple):
    """Points of both views that the other ought to show, and those amid a patch of which it shows none."""

    visible: int
    missing: int

    @property
    def missing_share(self) -> float:
        """0 if none is visible."""
        return self.missing / self.visible if self.visible else 0.0


def missing_points(query: CameraView, candidate: CameraView, T_c_q: F64) -> MissingPoints:
    """With T_c_q (4, 4): the query's body in the candidate's body frame."""
    in_candidate, in_query = _expected_both_ways(query, candidate, T_c_q, _FOUND_PX)
    return MissingPoints(
        len(in_candidate.is_found) + len(in_query.is_found),
        int(in_candidate.is_found.sum() + in_query.is_found.sum()),
    )


def missing_regions(query: CameraView, candidate: CameraView, T_c_q: F64) -> MissingRegions:
    """The same, of whole things: from about one spot, and within 1 m say little else is gone in a true pair.

    From further apart things hide each other that no keypoint tells of.
    """
    in_candidate, in_query = _expected_both_ways(query, candidate, T_c_q, _REGION_FOUND_PX)
    return MissingRegions(
        len(in_candidate.is_found) + len(in_query.is_found),
        _count_in_missing_regions(in_candidate) + _count_in_missing_regions(in_query),
    )


class _ExpectedPoints(NamedTuple):
    """Points of one view that the other camera ought to see: where (N, 2), and whether it does (N,)."""

    uv: F64
    is_found: NDArray[np.bool_]


def _expected_both_ways(
    query: CameraView, candidate: CameraView, T_c_q: F64, reach_px: float
) -> tuple[_ExpectedPoints, _ExpectedPoints]:
    T = se3.inverse(candidate.T_body_cam0) @ T_c_q @ query.T_body_cam0
    return _expected_points(T, query, candidate, reach_px), _expected_points(
        se3.inverse(T), candidate, query, reach_px
    )


def _expected_points(T: F64, source: CameraView, target: CameraView, reach_px: float) -> _ExpectedPoints:
    target_keypoints = target.keypoints
    if not len(source.view) or not len(target_keypoints):
        return _ExpectedPoints(np.zeros((0, 2)), np.zeros(0, bool))
    moved = transfer_keypoints(T, source.keypoints.T).T
    inside = np.flatnonzero(_is_inside(moved, target_keypoints))
    moved = moved[inside]
    rows, cols, px = _near_pairs(target.focal * moved[:, :2], target.focal * target_keypoints[:, :2])
    bits = hamming_rowwise(source.view.descriptors[inside[rows]], target.view.descriptors[cols])
    is_found = np.zeros(len(inside), bool)
    is_found[rows[(px < reach_px) & (bits <= _MAX_BITS)]] = True
    nearby_rho = np.full(len(inside), np.inf)  # least inverse depth of those near it
    np.fmin.at(nearby_rho, rows, target_keypoints[cols, 2])
    is_visible = nearby_rho <= _OCCLUSION_RATIO * moved[:, 2] + _OCCLUSION_RHO
    return _ExpectedPoints(moved[is_visible, :2], is_found[is_visible])


def _count_in_missing_regions(expected: _ExpectedPoints) -> int:
    """How many points are amid others of which none is found."""
    missing_uv = expected.uv[~expected.is_found]
    is_isolated = ~_is_within(missing_uv, expected.uv[expected.is_found], _REGION_RAD).any(1)
    is_in_region = _is_within(missing_uv[is_isolated], missing_uv, _REGION_RAD).sum(1) >= _MIN_REGION_POINTS
    return int(is_in_region.sum())


def _is_within(a: F64, b: F64, radius: float) -> NDArray[np.bool_]:
    """Which of a (N, 2) and b (K, 2) lie nearer than reach to each other (N, K)."""
    square = (a[:, :1] - b[:, 0]) ** 2 + (a[:, 1:] - b[:, 1]) ** 2
    return np.asarray(square < radius**2)


def _is_inside(moved: F64, target: F64) -> NDArray[np.bool_]:
    """Within the part of the image where the target has keypoints; not if it has no image (NaN)."""
    low, high = target[:, :2].min(0), target[:, :2].max(0)
    margin = _BORDER_SHARE * (high - low)
    return np.asarray(((moved[:, :2] > low + margin) & (moved[:, :2] < high - margin)).all(1))


def _near_pairs(a: F64, b: F64) -> tuple[I64, I64, F64]:
    """Which of a (N, 2) and b (K, 2) are near, pixels: rows, columns, distances (M,)."""
    distances = KDTree(a).sparse_distance_matrix(KDTree(b), _OCCLUDER_PX, output_type="ndarray")
    return distances["i"], distances["j"], distances["v"]
