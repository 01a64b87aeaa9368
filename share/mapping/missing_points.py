"""Missing points of two views, given the relative pose from verification.

Two places that look alike share most points, but what only one of them has is missing in the other. Single
points are missing anywhere (missed detections, occlusion); where all points of a patch of the image are
missing, a *thing* is missing: a poster, a door, a box. Distributions: docs/understand/place-recognition.md.
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

MIN_POINTS = 20  # visible in a pair of views; below, the pair is not informative
_FOUND_PX = 6.0  # radius within which a point is found
_REGION_FOUND_PX = 15.0  # the same for patches: the map may have drifted
_MAX_BITS = 90  # descriptor distance of a found point
_OCCLUDER_PX = 40.0  # radius of the keypoints that may occlude a point
_BORDER_SHARE = 0.03  # of each side of the image, where the detector finds nothing
# A point is occluded if all keypoints around it have inverse depths above ratio * rho + offset.
_OCCLUSION_RATIO = 1.2
_OCCLUSION_RHO = 0.02  # 1/m
_REGION_RAD = 0.1  # radius of a patch
_MIN_REGION_POINTS = 10  # visible points in a patch: if none is found, the patch is missing


class MissingPoints(NamedTuple):
    """Points of both views that should be visible in the other, and how many are found."""

    visible: int
    found: int

    @property
    def missing_share(self) -> float:
        """Share of the visible points that are not found; 0 if none is visible."""
        return 1 - self.found / self.visible if self.visible else 0.0


class MissingRegions(NamedTuple):
    """Points of both views that should be visible in the other, those in patches without any found, and those
    found."""

    visible: int
    missing: int
    found: int

    @property
    def missing_share(self) -> float:
        """Share of the visible points in missing patches; 0 if none is visible."""
        return self.missing / self.visible if self.visible else 0.0

    @property
    def is_informative(self) -> bool:
        return self.visible >= MIN_POINTS

    @property
    def found_share(self) -> float:
        """Share of the visible points that are found, a little off too; 1 if none is visible."""
        return self.found / self.visible if self.visible else 1.0


def missing_points(query: CameraView, candidate: CameraView, T_c_q: F64) -> MissingPoints:
    """Count visible and found points, given T_c_q (4, 4): the query's body in the candidate's body frame."""
    in_candidate, in_query = _expected_both_ways(query, candidate, T_c_q, _FOUND_PX)
    return MissingPoints(
        len(in_candidate.is_found) + len(in_query.is_found),
        int(in_candidate.is_found.sum() + in_query.is_found.sum()),
    )


def vanished_regions(old: CameraView, new: CameraView, T_new_old: F64) -> MissingRegions:
    """Count the points of an old view that a new one should show, and those that are gone from it."""
    T = se3.inverse(new.T_body_cam0) @ T_new_old @ old.T_body_cam0
    expected = _expected_points(T, old, new, _REGION_FOUND_PX)
    found = int(expected.is_found.sum())
    return MissingRegions(len(expected.is_found), _count_in_missing_regions(expected), found)


def missing_regions(query: CameraView, candidate: CameraView, T_c_q: F64) -> MissingRegions:
    """Count visible points and those in missing patches.

    For views from about one spot: within 1 m little else is missing in a true pair. Farther apart, things
    occlude each other without a keypoint to show it.
    """
    in_candidate, in_query = _expected_both_ways(query, candidate, T_c_q, _REGION_FOUND_PX)
    return MissingRegions(
        len(in_candidate.is_found) + len(in_query.is_found),
        _count_in_missing_regions(in_candidate) + _count_in_missing_regions(in_query),
        int(in_candidate.is_found.sum() + in_query.is_found.sum()),
    )


class _ExpectedPoints(NamedTuple):
    """Points of one view that should be visible in the other: position there (N, 2), is_found (N,)."""

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
    rows, cols, px = _near_keypoints(target.focal * moved[:, :2], target.focal * target_keypoints[:, :2])
    near_rows, near_cols = rows[px < reach_px], cols[px < reach_px]
    bits = hamming_rowwise(source.view.descriptors[inside[near_rows]], target.view.descriptors[near_cols])
    is_found = np.zeros(len(inside), bool)
    is_found[near_rows[bits <= _MAX_BITS]] = True
    nearby_rho = np.full(len(inside), np.inf)  # least inverse depth of keypoints around
    np.fmin.at(nearby_rho, rows, target_keypoints[cols, 2])
    is_visible = nearby_rho <= _OCCLUSION_RATIO * moved[:, 2] + _OCCLUSION_RHO
    return _ExpectedPoints(moved[is_visible, :2], is_found[is_visible])


def _count_in_missing_regions(expected: _ExpectedPoints) -> int:
    """Count points in patches without a found point."""
    missing_uv = expected.uv[~expected.is_found]
    is_isolated = ~_are_within(missing_uv, expected.uv[expected.is_found], _REGION_RAD).any(1)
    is_in_region = _are_within(missing_uv[is_isolated], missing_uv, _REGION_RAD).sum(1) >= _MIN_REGION_POINTS
    return int(is_in_region.sum())


def _are_within(a: F64, b: F64, radius: float) -> NDArray[np.bool_]:
    """Mask (N, K) of points a (N, 2) and b (K, 2) nearer than `radius`."""
    square = (a[:, :1] - b[:, 0]) ** 2 + (a[:, 1:] - b[:, 1]) ** 2
    return np.asarray(square < radius**2)


def _is_inside(moved: F64, target: F64) -> NDArray[np.bool_]:
    """Mask of points in the part of the image where the target has keypoints; False for NaN."""
    low, high = target[:, :2].min(0), target[:, :2].max(0)
    margin = _BORDER_SHARE * (high - low)
    return np.asarray(((moved[:, :2] > low + margin) & (moved[:, :2] < high - margin)).all(1))


def _near_keypoints(a: F64, b: F64) -> tuple[I64, I64, F64]:
    """Pairs of points a (N, 2) and b (K, 2), pixels, that are near: rows, columns, distances (M,)."""
    distances = KDTree(a).sparse_distance_matrix(KDTree(b), _OCCLUDER_PX, output_type="ndarray")
    return distances["i"], distances["j"], distances["v"]
