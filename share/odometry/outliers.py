"""Which features belong to the room, where some move by themselves: consensus guided by the IMU.

A person or robot that fills much of the view is as rigid as the room, so counting votes decides nothing.
What decides is what the IMU says of the motion, and how much of the image agrees. After IMU-PARSAC of
RD-VIO (Li et al. 2024), with a prior in place of its thresholds and no random numbers: every part of the
image proposes a motion, every feature judges it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import Camera, rays
from share.odometry import filter
from share.odometry.filter import FeatureMeasurements
from share.odometry.relocalisation import ransac_pose
from share.odometry.state import POSE, FilterState
from share.odometry.track_result import median
from share.types import F32, F64, I64
from share.vision.corners import cell_indices

_INLIER_SIGMAS = 3.0  # sigmas of a feature's own
_MAX_OUTLIER_SHARE = 0.15  # of the features may disagree with the rest before anybody is asked
_REGIONS, _CELLS = (4, 3), (8, 6)  # of the image: who proposes, and what counts
_MIN_GROUP = 4  # features that propose
_PROPOSAL_SCALE = 10.0  # times the prior's sigmas: what a proposal may be off
_PRIOR_SCALE = 2.0  # times the prior's sigmas: what the filter is really worth
_MAX_MOTION_COST = 4.0  # a surprise that asks for a second look,
_COST_CAP = 12.0  # and cells that one can cost
_ITERATIONS = 3
_MAX_PRIOR_RATIO = 6.0  # times a feature's sigma: where the filter knows a place no better, it is no help
_CONSENSUS_PX = 3.0
_MIN_RHO = 1e-3  # 1/m
_MIN_PRIOR_VARIANCE = np.repeat([1e-4, 2e-4], 3) ** 2  # rad^2, m^2


def matches_imu(residual: F64, sigma: float, correlated_sigma: float) -> bool:
    """Whether nearly all features are where the IMU alone has them, so that nobody needs to be asked.
    residual (M, 2), sigma and lasting of each coordinate."""
    nis = (residual**2).sum(axis=1) / (sigma**2 + correlated_sigma**2)
    return bool((nis < _INLIER_SIGMAS**2).mean() > 1 - _MAX_OUTLIER_SHARE)


def static_inliers(
    state: FilterState, rows: FeatureMeasurements, px: F32, proven: NDArray[np.bool_], camera: Camera
) -> NDArray[np.bool_]:
    """Which rows (M,) of one camera move with the room; all where there is no doubt. px (M, 2): where they
    are seen. proven (M,): whose word counts."""
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
    """Which of features `which` (M,), seen at px (M, 2), agree on a pose, whatever the filter expects; all
    where less than half do."""
    T_odom_anchor = state.keyframe_poses[state.anchor[indices]] @ state.T_body_cam
    in_anchor = rays(state.ray[indices]) / np.maximum(state.rho[indices, None], _MIN_RHO)
    points = (T_odom_anchor[:, :3, :3] @ in_anchor[:, :, None])[:, :, 0] + T_odom_anchor[:, :3, 3]
    estimate = ransac_pose(
        points, camera.normalise(px.astype(np.float64)), camera.focal, _CONSENSUS_PX, seed=0
    )
    if estimate is None or estimate.inliers.mean() < 0.5:
        return np.ones(len(indices), bool)
    return estimate.inliers


def _grow_group(fit: _MotionFit, group: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """All that agree with the motion of a group (M,), that of all that agree with that, and so on."""
    if group.sum() < _MIN_GROUP:
        return np.zeros(len(group), bool)
    for _ in range(_ITERATIONS):
        group = fit.inliers(fit.motion(group, _PROPOSAL_SCALE))
        if group.sum() < _MIN_GROUP:
            break
    return group


class _MotionFit:
    """A common motion e (6,) of the camera: rows' residuals = J e + their own noise, e being about 0 by IMU.
    In units of the prior's sigmas."""

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
        """How well the places of features are known beforehand, median, in sigmas of what is seen."""
        return float(np.median(np.linalg.norm(self._J, axis=(1, 2))) / np.sqrt(2))

    def motion(self, group: NDArray[np.bool_], sigmas: float, weight: F64 | None = None) -> F64:
        """The best (6,) of a group (M,) of rows."""
        J, r = self._J[group].reshape(-1, 6), self._r[group].ravel()
        weighted = J if weight is None else J * np.repeat(weight[group], 2)[:, None]
        out: F64 = np.linalg.solve(weighted.T @ J + np.eye(6) / sigmas**2, weighted.T @ r)
        return out

    def robust_motion(self, group: NDArray[np.bool_]) -> F64:
        """Of a group (M,), from what the IMU says, those that are off counting less (Cauchy)."""
        e = np.zeros(6)
        for _ in range(_ITERATIONS):
            e = self.motion(group, _PRIOR_SCALE, 1 / (1 + (self.whitened_distance(e) / _INLIER_SIGMAS) ** 2))
        return e

    def whitened_distance(self, e: F64) -> F64:
        """(M,) sigmas."""
        out: F64 = np.linalg.norm(self._r - self._J @ e, axis=1)
        return out

    def inliers(self, e: F64) -> NDArray[np.bool_]:
        out: NDArray[np.bool_] = self.whitened_distance(e) < _INLIER_SIGMAS
        return out

    def motion_cost(self, group: NDArray[np.bool_]) -> float:
        """How unlikely the IMU finds a group's motion, up to _MOST."""
        if group.sum() < _MIN_GROUP:
            return np.inf
        e = self.motion(group, _PROPOSAL_SCALE) / _PRIOR_SCALE
        return min(float(e @ e) / 2, _COST_CAP)


# ---- Whether images and IMU tell of one motion, and whether the filter is where it takes itself to be.

_AVERAGING_S, _MIN_DURATION_S = 5.0, 1.0  # averaged over; of frames, before anything is said
_SETTLING_S = 1.0  # in which a filter that has just begun finds its bearings
_MIN_MEASUREMENTS = 25  # features that say something
_MAX_EMPTY_FRAMES, _MAX_REJECTED_S = (
    3,
    1.0,
)  # frames with nothing of what should be there; time with nothing believed
_MAX_INTERVAL_S = 0.2  # that one frame counts for
_MAX_MEDIAN_NIS = 0.8  # of the median squared Mahalanobis distance, which is 0.05 to 0.6 where all is well


class ImageImuConsistency:
    """A camera that is turned or shifted against its calibration, or whose clock is off, is tracked all the
    same, a little beside where the IMU says, all features alike, frame after frame: none is refused for it.
    With 5 degrees and 5 cm the median rises to 1.2 to 3 (docs/understand/odometry.md)."""

    def __init__(self) -> None:
        self._mean, self._seconds = 0.0, 0.0

    def add(self, nis: F64, interval_s: float) -> None:
        """`ekf.surprise` (M,) of a frame's features, and how long it was since the frame before."""
        if len(nis) < _MIN_MEASUREMENTS:
            return
        self._seconds += interval_s
        measured_s = self._seconds - _SETTLING_S
        if measured_s <= 0:
            return
        gain = min(interval_s / min(measured_s, _AVERAGING_S), 1.0)
        self._mean += gain * (median(nis) - self._mean)

    @property
    def is_consistent(self) -> bool:
        """False where they contradict each other."""
        return self._seconds < _SETTLING_S + _MIN_DURATION_S or self._mean < _MAX_MEDIAN_NIS


class DivergenceMonitor:
    """Frames that show something and nothing of what they should, or for long nothing that is believed: then
    the filter is wrong, and not the light. What has left the view tells nothing."""

    def __init__(self, weak: int, blind: int) -> None:
        """So many features are little to go by; with fewer than `blind` there is no seeing."""
        self._weak, self._blind = weak, blind
        self._empty_frames, self._rejected_s = 0, 0.0

    def add(
        self, textured: bool, in_view: int, found_count: int, inlier_count: int, interval_s: float
    ) -> None:
        """A frame, `interval_s` after the one before. textured: it shows something. Of the filter's features
        `in_view` should be in view, `found_count` look as they should, `seen` were believed as well."""
        if textured and in_view >= self._weak:
            self._empty_frames = self._empty_frames + 1 if found_count < self._blind else 0
        if in_view >= self._blind:  # else all was refused in the frame before, and is gone
            rejected = textured and inlier_count < self._blind
            self._rejected_s = self._rejected_s + min(interval_s, _MAX_INTERVAL_S) if rejected else 0.0

    @property
    def is_suspected(self) -> bool:
        """True from the first such frame on."""
        return self._empty_frames > 0 or self._rejected_s > 0

    @property
    def has_diverged(self) -> bool:
        """True where it has gone on for too long."""
        return self._empty_frames >= _MAX_EMPTY_FRAMES or self._rejected_s > _MAX_REJECTED_S


def is_plausible(s: FilterState, config: InertialConfig) -> bool:
    """Finite, no faster than a person or robot can be, and not gone too far unseen."""
    finite = np.isfinite(s.T).all() and np.isfinite(s.v).all() and np.isfinite(s.cov).all()
    return bool(finite and np.linalg.norm(s.v) < config.max_speed_m_s and filter.drift_m(s) < config.lost_m)
