"""Update the filter with the matches of a frame: reject what moves in the room, linearise, gate, update.

The covariance is inflated first where the images agree with each other but not with the propagated state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.geometry.absolute_pose import RansacOptions, absolute_pose
from share.geometry.camera import Camera, rays
from share.odometry import filter
from share.odometry.feature_matching import FeatureMatches
from share.odometry.filter import FeatureMeasurements
from share.odometry.health import MIN_OK_FEATURES
from share.odometry.landmarks import CORRELATED_SIGMA_PX, LandmarkMap
from share.odometry.state import POSE, FilterState, submatrix
from share.odometry.track_result import median
from share.types import F32, F64, I64
from share.vision.corners import cell_indices

# Of a pose error that all measurements of an image share (blur, time offset); rad^2, m^2.
COMMON_COV = np.diag(np.repeat([1e-3**2, 1e-4**2], 3))
_RELINEARISE_PX = 1.0  # median residual above which the update is iterated
# If the gate accepts fewer than these shares of the matches, after a gap or with suspect IMU samples, and
# more than the second share agree on a pose, the covariance is inflated.
_MIN_ACCEPTED_SHARE = 0.3
_MIN_CONSENSUS_SHARE = 0.7
_GAP_INFLATION = 0.02, 0.1, 0.3  # rad, m, m/s


class _Gated(NamedTuple):
    """Measurements (M,), which of them pass the gate, their NIS, and their innovation covariance."""

    rows: FeatureMeasurements
    accepted: NDArray[np.bool_]
    nis: F64
    HP: filter.FloatArray
    S: filter.FloatArray


def update(
    landmarks: LandmarkMap,
    matches: FeatureMatches,
    camera: Camera,
    rate: F64,
    is_after_gap: bool,
    is_suspect: bool,
) -> tuple[NDArray[np.bool_], F64]:
    """Update the state with the static matches. Return the inliers (N,) and the NIS of the measurements.

    camera: cam0. rate (3,): rad/s of the body. is_after_gap, is_suspect: the propagation may be wrong,
    because it was long or some IMU samples are suspect.
    """
    s = landmarks.state

    def make_rows() -> FeatureMeasurements:
        return landmarks.frame_measurements(matches, rate)

    inliers = matches.is_found & ~matches.is_dynamic
    rows = make_rows()
    if len(rows.feature) == 0:
        return inliers, np.zeros(0)
    gated = _gate(s, rows, make_rows, camera.focal)
    share = gated.accepted.mean()
    is_contradicted = (is_after_gap and share < _MIN_ACCEPTED_SHARE) or (
        is_suspect and share < _MIN_CONSENSUS_SHARE
    )
    if is_contradicted and _images_agree(s, matches, camera):
        filter.inflate(s, *_GAP_INFLATION)
        gated = _gate(s, gated.rows, make_rows, camera.focal)
    rows, accepted, nis, HP, S = gated
    if accepted.all():
        filter.update(s, rows, HP, S)
    elif accepted.any():
        row_pairs = np.flatnonzero(np.repeat(accepted, 2))
        S = submatrix(S, row_pairs)
        filter.update(s, rows.take(accepted), HP.take(row_pairs, axis=0), S)
    inliers[rows.feature[~accepted]] = False
    return inliers, nis


def _gate(
    s: FilterState, rows: FeatureMeasurements, make_rows: Callable[[], FeatureMeasurements], focal: float
) -> _Gated:
    """Gate the measurements at the best linearisation. A feature must pass in both cameras."""
    if median(np.abs(rows.residual).ravel()) * focal > _RELINEARISE_PX:
        rows = filter.relinearised_rows(s, make_rows, COMMON_COV)
    HP, S = filter.innovation_covariance(s, rows, COMMON_COV)
    nis = filter.nis(rows, S)
    accepted = np.ones(len(s.feature_ids), bool)
    accepted[rows.feature[nis >= filter.GATE]] = False
    return _Gated(rows, accepted[rows.feature], nis, HP, S)


def _images_agree(s: FilterState, matches: FeatureMatches, camera: Camera) -> bool:
    """Return whether nearly all matches in cam0 agree on a pose."""
    indices = np.flatnonzero(matches.is_found & ~matches.is_dynamic)
    if len(indices) < MIN_OK_FEATURES:
        return False
    inliers = consensus_inliers(s, indices, matches.px[indices], camera)
    return bool(inliers.mean() > _MIN_CONSENSUS_SHARE)


# Separate static from dynamic features: consensus guided by the IMU.
#
# A person or robot that fills much of the view is as rigid as the room, so the size of a consensus decides
# nothing. What decides is how well a motion agrees with the IMU, and how much of the image agrees with it.
# After IMU-PARSAC of RD-VIO (Li et al. 2024), with a prior in place of its thresholds and without random
# numbers: every region of the image proposes a motion, all features score it.

_INLIER_SIGMAS = 3.0  # of a feature's noise
_MAX_OUTLIER_SHARE = 0.15  # of the features; with more outliers, proposals are compared
_REGIONS = (4, 3)  # of the image, across and down; each proposes a motion
_CELLS = (8, 6)  # of the image; a motion scores the cells that agree with it
_MIN_GROUP = 4  # features of a proposal
_PROPOSAL_SCALE = 10.0  # prior sigmas of a proposal's motion
_PRIOR_SCALE = 2.0  # true sigma of the prior / the filter's
_MAX_MOTION_COST = 4.0  # with a higher cost, proposals are compared
_COST_CAP = 12.0  # cells
_ITERATIONS = 3
_MAX_PRIOR_RATIO = 6.0  # of predicted to measured sigmas; above it the prior does not help
_CONSENSUS_PX = 3.0
_MIN_RHO = 1e-3  # 1/m
_MIN_PRIOR_VARIANCE = np.repeat([1e-4, 2e-4], 3) ** 2  # rad^2, m^2


def mark_dynamic(landmarks: LandmarkMap, matches: FeatureMatches, camera: Camera, rate: F64) -> None:
    """Mark dynamic features among the matches in cam0, in place, where the IMU alone does not explain the
    image. rate (3,): rad/s of the body."""
    indices = np.flatnonzero(matches.is_found)
    residual = camera.to_image_plane(matches.uv[indices]) - camera.to_image_plane(
        matches.predicted_uv[indices]
    )
    if len(indices) == 0 or matches_imu(residual * camera.focal, landmarks.sigma_px):
        return
    rows = landmarks.cam0_measurements(matches.uv, indices, rate)
    static = static_inliers(landmarks.state, rows, matches.px[indices], landmarks.is_proven(indices), camera)
    matches.is_dynamic[indices[~static]] = True


def matches_imu(residual: F64, sigma_px: float) -> bool:
    """Return whether nearly all residuals (M, 2) px agree with the prediction, so that no consensus is
    needed."""
    nis = (residual**2).sum(axis=1) / (sigma_px**2 + CORRELATED_SIGMA_PX**2)
    return bool((nis < _INLIER_SIGMAS**2).mean() > 1 - _MAX_OUTLIER_SHARE)


def static_inliers(
    state: FilterState, rows: FeatureMeasurements, px: F32, proven: NDArray[np.bool_], camera: Camera
) -> NDArray[np.bool_]:
    """Return which measurements (M,) of one camera move with the room; all where there is no sign of motion.

    px (M, 2): their positions. proven (M,): the features whose cells score a motion.
    """
    all_rows, size = np.ones(len(rows.feature), bool), (camera.width, camera.height)
    if len(rows.feature) < 2 * _MIN_GROUP:
        return all_rows
    fit = _MotionFit(state, rows)
    if fit.prior_ratio > _MAX_PRIOR_RATIO:
        return consensus_inliers(state, rows.feature, px, camera)
    inliers = fit.inliers(fit.robust_motion(proven if proven.sum() >= 2 * _MIN_GROUP else all_rows))
    if inliers.mean() > 1 - _MAX_OUTLIER_SHARE and fit.motion_cost(inliers) < _MAX_MOTION_COST:
        return all_rows
    region, cell = cell_indices(px, size, _REGIONS), cell_indices(px, size, _CELLS)
    proposals = [inliers, *(_grow_group(fit, region == k) for k in np.unique(region))]
    scores = [len(np.unique(cell[group & proven])) - fit.motion_cost(group) for group in proposals]
    return proposals[int(np.argmax(scores))]


def consensus_inliers(state: FilterState, indices: I64, px: F32, camera: Camera) -> NDArray[np.bool_]:
    """Return which of features `indices` (M,), at px (M, 2), agree on a pose, without the filter's
    prediction; all where less than half do."""
    T_odom_anchor = state.keyframe_poses[state.anchor[indices]] @ state.T_body_cam
    in_anchor = rays(state.ray[indices]) / np.maximum(state.rho[indices, None], _MIN_RHO)
    points = (T_odom_anchor[:, :3, :3] @ in_anchor[:, :, None])[:, :, 0] + T_odom_anchor[:, :3, 3]
    if len(points) < _MIN_GROUP:
        return np.ones(len(indices), bool)
    uv = camera.normalise(px.astype(np.float64))
    _, inliers = absolute_pose(points, uv, camera.focal, RansacOptions(_CONSENSUS_PX, seed=0))
    has_consensus = inliers.sum() >= max(_MIN_GROUP, 0.5 * len(indices))
    return inliers if has_consensus else np.ones(len(indices), bool)


def _grow_group(fit: _MotionFit, group: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the features that agree with the motion of a group (M,), after several iterations; none or
    few if it dissolves."""
    if group.sum() < _MIN_GROUP:
        return np.zeros(len(group), bool)
    for _ in range(_ITERATIONS):
        group = fit.inliers(fit.motion(group, _PROPOSAL_SCALE))
        if group.sum() < _MIN_GROUP:
            break
    return group


class _MotionFit:
    """Fits a motion e (6,) of the camera relative to its prediction: residuals = J e + noise, in units of
    the prior's sigmas."""

    def __init__(self, state: FilterState, rows: FeatureMeasurements) -> None:
        prior = filter.motion_cov_since_keyframe(state) + np.diag(_MIN_PRIOR_VARIANCE)
        J = rows.H_core[:, :, POSE] @ se3.adjoint(state.T) @ np.linalg.cholesky(prior)
        rho_variance = state.rho_variance[rows.feature, None, None]
        depth_noise: F64 = rows.H_rho[:, :, None] * rows.H_rho[:, None, :] * rho_variance
        pixel_noise = (rows.sigma**2 + rows.correlated_sigma**2)[:, None, None] * np.eye(2)
        whitening = np.linalg.inv(np.linalg.cholesky(depth_noise + pixel_noise))
        self._J, self._r = whitening @ J, (whitening @ rows.residual[:, :, None])[:, :, 0]

    @property
    def prior_ratio(self) -> float:
        """The median ratio of a feature's predicted sigma to its measurement sigma."""
        return float(np.median(np.linalg.norm(self._J, axis=(1, 2))) / np.sqrt(2))

    def motion(self, group: NDArray[np.bool_], sigmas: float, weight: F64 | None = None) -> F64:
        """Return the least-squares motion (6,) of a group (M,), with a prior of 0 and `sigmas`."""
        J, r = self._J[group].reshape(-1, 6), self._r[group].ravel()
        weighted = J if weight is None else J * np.repeat(weight[group], 2)[:, None]
        out: F64 = np.linalg.solve(weighted.T @ J + np.eye(6) / sigmas**2, weighted.T @ r)
        return out

    def robust_motion(self, group: NDArray[np.bool_]) -> F64:
        """Return the motion (6,) of a group (M,) by Cauchy weights, from a start at 0."""
        e = np.zeros(6)
        for _ in range(_ITERATIONS):
            e = self.motion(group, _PRIOR_SCALE, 1 / (1 + (self.whitened_distance(e) / _INLIER_SIGMAS) ** 2))
        return e

    def whitened_distance(self, e: F64) -> F64:
        """Return the residuals (M,) of a motion, in sigmas."""
        out: F64 = np.linalg.norm(self._r - self._J @ e, axis=1)
        return out

    def inliers(self, e: F64) -> NDArray[np.bool_]:
        out: NDArray[np.bool_] = self.whitened_distance(e) < _INLIER_SIGMAS
        return out

    def motion_cost(self, group: NDArray[np.bool_]) -> float:
        """Return half the squared norm of a group's motion in true prior sigmas, at most `_COST_CAP`; inf
        for a small group."""
        if group.sum() < _MIN_GROUP:
            return np.inf
        e = self.motion(group, _PROPOSAL_SCALE) / _PRIOR_SCALE
        return min(float(e @ e) / 2, _COST_CAP)
