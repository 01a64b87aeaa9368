"""Initial values without any guess: poses of the board, time offset, rotation of the extrinsics, gravity.

Camera and IMU are one rigid body, so at the right time offset their angular rates differ by a rotation and a
bias. For each offset the best rotation has a closed form (Umeyama, PAMI 1991, eq. 40); the correlation of the
two rate series peaks at the right offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.errors import CalibrationMismatchError, DataError
from share.geometry import se3
from share.geometry.camera import Camera
from share.geometry.interpolation import subsample_peak
from share.geometry.se3 import best_rotation
from share.lab.calibrate import camera_initialisation
from share.lab.calibrate.camera_imu.spline import EXTRA_KNOTS, Curve
from share.lab.calibrate.camera_imu.state import CameraImuState, node_count
from share.lab.calibrate.corner_observations import BoardView, CornerObservations
from share.lab.calibrate.target import Target
from share.types import F64, I64, ImuBatch

KNOT_STEP_S = 0.02  # between knots: follows hand motion, up to 10 Hz and more
BIAS_NODE_S = 5.0  # between bias nodes
END_MARGIN_S = 0.05  # images nearer to the ends are left out: the final offset may shift them beyond
_LAG_S = 0.005  # between the time offsets tried
_MAX_PAIR_GAP_S = 0.25  # between two images that give a rate
_MIN_PAIRS = 50
_MIN_CORRELATION = 0.6
_MIN_SECOND_AXIS_RATE = 0.05  # rad/s rms about the second axis; below, the extrinsics are not observable
_ITERATIONS = 8
_HUBER_PX = 2.5


def initial_poses(
    views: Sequence[BoardView], target: Target, cameras: Sequence[Camera], mounts: Sequence[F64]
) -> tuple[F64, np.ndarray]:
    """Return T_target_cam0 (F, 4, 4) by homographies, each from the camera that sees most corners, and
    which views (F,) have enough corners for one."""
    out, has_pose = np.tile(np.eye(4), (len(views), 1, 1)), np.zeros(len(views), bool)
    for k, view in enumerate(views):
        cam = int(np.argmax([len(one) for one in view.detections]))
        board, px = target.corners[view.detections[cam].ids, :2], view.detections[cam].px
        if camera_initialisation.has_enough_corners(board):
            T_cam_target = camera_initialisation.board_pose(cameras[cam], board, px)
            out[k], has_pose[k] = se3.inverse(T_cam_target) @ mounts[cam], True
    return out, has_pose


def refine_poses(observations: CornerObservations, T_target_cam0: F64) -> F64:
    """Refine each frame's pose alone, by Gauss-Newton."""
    T = se3.inverse(T_target_cam0)
    for _ in range(_ITERATIONS):
        step = observations.normals(T, _HUBER_PX)
        if not np.isfinite(step.cost):
            break
        xi = np.linalg.solve(step.H + 1e-9 * np.eye(6), step.g[..., None])[..., 0]
        T = T @ se3.exp(np.asarray(xi, np.float64))
    return se3.inverse(T)


@dataclass(frozen=True, eq=False)
class ClockAlignment:
    """t_imu = t_cam + shift_s; R_imu_cam0 (3, 3); gyro_bias (3,) rad/s; correlation of the rates, 1 for a
    perfect match."""

    shift_s: float
    R_imu_cam0: F64
    gyro_bias: F64
    correlation: float


def align_clocks(stamps_ns: I64, T: F64, imu: ImuBatch, within_s: float) -> ClockAlignment:
    """Align the clocks by poses T (F, 4, 4) of cam0 at stamps (F,), for offsets up to within_s.

    Raises DataError where there are too few images or the rig turned about one axis only,
    CalibrationMismatchError where the rates match at no offset.
    """
    first = np.flatnonzero(np.diff(stamps_ns) < _MAX_PAIR_GAP_S * 1e9)
    if len(first) < _MIN_PAIRS:
        raise DataError(
            f"the board is seen in {len(first)} pairs of successive images, {_MIN_PAIRS} are needed: "
            "keep it in view, and use every image"
        )
    span = (stamps_ns[first + 1] - stamps_ns[first])[:, None] * 1e-9
    rates = se3.so3_log(T[first, :3, :3].swapaxes(1, 2) @ T[first + 1, :3, :3]) / span
    rms_by_axis = np.linalg.svd(rates - rates.mean(axis=0), compute_uv=False) / np.sqrt(len(rates))
    if rms_by_axis[1] < _MIN_SECOND_AXIS_RATE:
        raise DataError(
            f"the rig turned by {rms_by_axis[0]:.2f} rad/s rms about one axis and {rms_by_axis[1]:.2f} about "
            f"the next, {_MIN_SECOND_AXIS_RATE} are needed: nod, roll and look around"
        )
    mean_rates = _MeanRates(imu)
    lags = np.arange(-within_s, within_s + _LAG_S / 2, _LAG_S)
    ends = stamps_ns[first], stamps_ns[first + 1]
    correlations = np.array([_rate_correlation(rates, mean_rates.rates(*ends, lag))[0] for lag in lags])
    best = int(correlations.argmax())
    if correlations[best] < _MIN_CORRELATION:
        raise CalibrationMismatchError(
            f"the rotation rates of camera and IMU match at no time offset up to {within_s:g} s (correlation "
            f"{correlations[best]:.2f}, {_MIN_CORRELATION} needed): are both of one device, and the IMU in "
            "rad/s?"
        )
    shift = float(lags[best] + subsample_peak(correlations, best) * _LAG_S)
    gyro = mean_rates.rates(*ends, shift)
    correlation, R = _rate_correlation(rates, gyro)
    return ClockAlignment(shift, R, gyro.mean(axis=0) - R @ rates.mean(axis=0), correlation)


class _MeanRates:
    """Mean gyro rates between any two times."""

    def __init__(self, imu: ImuBatch) -> None:
        self._start = imu.stamps_ns[0]
        self._t = (imu.stamps_ns - self._start) * 1e-9
        steps = (imu.gyro[1:] + imu.gyro[:-1]) / 2 * np.diff(self._t)[:, None]
        self._sum = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def rates(self, from_ns: I64, to_ns: I64, shift_s: float) -> F64:
        """Return (N, 3) rad/s between stamps (N,), both shifted."""
        a, b = ((stamps - self._start) * 1e-9 + shift_s for stamps in (from_ns, to_ns))
        turn = [np.interp(b, self._t, one) - np.interp(a, self._t, one) for one in self._sum.T]
        return np.asarray(np.stack(turn, axis=1) / (b - a)[:, None], np.float64)


def _rate_correlation(camera: F64, gyro: F64) -> tuple[float, F64]:
    """Return the correlation of rates (N, 3) with the camera's rotated best, and that rotation (3, 3)."""
    a, b = camera - camera.mean(axis=0), gyro - gyro.mean(axis=0)
    R = best_rotation(b.T @ a)
    return float((b * (a @ R.T)).sum() / np.sqrt((a * a).sum() * (b * b).sum() + 1e-300)), R


def initial_state(stamps_ns: I64, T: F64, imu: ImuBatch, alignment: ClockAlignment) -> CameraImuState:
    """Return a state with knots interpolated between the poses T (F, 4, 4) of cam0, which starts at the
    IMU's position."""
    shifted: I64 = stamps_ns + round(alignment.shift_s * 1e9)
    begin = max(int(shifted[0]) - round(2 * END_MARGIN_S * 1e9), int(imu.stamps_ns[0]))
    end = min(int(shifted[-1]) + round(2 * END_MARGIN_S * 1e9), int(imu.stamps_ns[-1]))
    segments = int((end - begin) * 1e-9 / KNOT_STEP_S)
    if segments * KNOT_STEP_S < 1:
        raise DataError("IMU and images of the board overlap by less than a second; record both together")
    knots: F64 = np.arange(segments + EXTRA_KNOTS, dtype=np.float64)
    knot_times: F64 = (knots - (EXTRA_KNOTS - 1) / 2) * KNOT_STEP_S  # where each has its largest weight
    t = np.asarray((shifted - begin) * 1e-9, np.float64)
    R = _interpolated_rotations(t, T[:, :3, :3] @ alignment.R_imu_cam0.T, knot_times)
    p = np.stack([np.interp(knot_times, t, column) for column in T[:, :3, 3].T], axis=1)
    curve = Curve(begin, KNOT_STEP_S, R, p)
    specific_force = np.stack([np.interp(t, (imu.stamps_ns - begin) * 1e-9, a) for a in imu.accel.T], axis=1)
    up = np.einsum("nij,nj->ni", T[:, :3, :3] @ alignment.R_imu_cam0.T, specific_force).mean(axis=0)
    per_node = round(BIAS_NODE_S / KNOT_STEP_S)
    biases = np.tile(np.append(alignment.gyro_bias, np.zeros(3)), (node_count(segments, per_node), 1))
    mount = se3.from_rt(alignment.R_imu_cam0, np.zeros(3))
    return CameraImuState(curve, biases, per_node, mount, alignment.shift_s, -up)


def _interpolated_rotations(t: F64, R: F64, times: F64) -> F64:
    """Return rotations (K, 3, 3) at times (K,), from R (N, 3, 3) at t (N,), rising."""
    from scipy.spatial.transform import Rotation, Slerp

    return np.asarray(Slerp(t, Rotation.from_matrix(R))(np.clip(times, t[0], t[-1])).as_matrix(), np.float64)
