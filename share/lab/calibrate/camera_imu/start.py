"""Where it begins, with no guess from anybody: poses of the board, clocks, the mounting's rotation, gravity.

Camera and IMU turn as one, so their rates differ by a rotation and a bias at the right offset of the clocks.
For each offset the best rotation is closed form (Umeyama, PAMI 1991, eq. 40), and how well it fits is the
correlation of two series of vectors, which has its peak at the offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.errors import DataError, MisfitError
from share.geometry import se3
from share.geometry.camera import Camera
from share.geometry.peak import between_steps
from share.geometry.se3 import rotation
from share.lab.calibrate import camera_start
from share.lab.calibrate.camera_bundle import View
from share.lab.calibrate.camera_imu.sights import Sights, pose_normal
from share.lab.calibrate.camera_imu.spline import EDGE, Curve
from share.lab.calibrate.camera_imu.state import State, nodes
from share.lab.calibrate.target import Target
from share.types import F64, I64, ImuBatch

STEP_S = 0.02  # between knots: carries what a hand does, up to 10 Hz and more
NODE_S = 5.0  # between nodes of the biases
EDGE_S = 0.05  # pictures nearer to the ends are left out: the offset may yet carry them beyond
_LAG_S = 0.005
_JOINED_S = 0.25  # pictures farther apart do not tell a rate
_LEAST_PAIRS = 50
_LEAST_CORRELATION = 0.6
_LEAST_RATE = 0.05  # rad/s rms about the second axis; below, the mounting cannot be told
_ROUNDS = 8


def first_poses(
    views: Sequence[View], target: Target, cameras: Sequence[Camera], mounts: Sequence[F64]
) -> tuple[F64, np.ndarray]:
    """T_target_cam0 (F, 4, 4) by homographies, each of the camera that sees most; and which views (F,) have
    enough corners for one."""
    out, told = np.tile(np.eye(4), (len(views), 1, 1)), np.zeros(len(views), bool)
    for k, view in enumerate(views):
        eye = int(np.argmax([len(one) for one in view.seen]))
        board, px = target.corners[view.seen[eye].ids, :2], view.seen[eye].px
        if camera_start.enough(board):
            T_cam_target = camera_start.pose(cameras[eye], board, px)
            out[k], told[k] = se3.inverse(T_cam_target) @ mounts[eye], True
    return out, told


def refined_poses(sights: Sights, T: F64, sigma_px: float = 1.0) -> F64:
    """Each frame by itself, by Gauss-Newton."""
    for _ in range(_ROUNDS):
        step = pose_normal(sights, T, sigma_px, 2.5)
        if not np.isfinite(step.cost):
            break
        xi = np.linalg.solve(step.H + 1e-9 * np.eye(6), step.g[..., None])[..., 0]
        T = T @ se3.exp(np.asarray(xi, np.float64))
    return T


@dataclass(frozen=True, eq=False)
class Alignment:
    """t_imu = t_cam + shift_s; R_imu_cam0 (3, 3); gyro's bias (3,) rad/s; correlation, 1 where they turn
    exactly alike."""

    shift_s: float
    R_imu_cam0: F64
    gyro_bias: F64
    correlation: float


def align(stamps_ns: I64, T: F64, imu: ImuBatch, within_s: float) -> Alignment:
    """By poses T (F, 4, 4) of cam0 at stamps (F,). Offsets up to within_s are looked at.

    Raises DataError where the pictures are too few or the rig turned about one axis only, MisfitError where
    camera and IMU turn nowhere alike.
    """
    first = np.flatnonzero(np.diff(stamps_ns) < _JOINED_S * 1e9)
    if len(first) < _LEAST_PAIRS:
        raise DataError(
            f"the board is seen in {len(first)} pairs of successive pictures, {_LEAST_PAIRS} are needed: "
            "keep it in view, and look at every picture"
        )
    span = (stamps_ns[first + 1] - stamps_ns[first])[:, None] * 1e-9
    rates = se3.so3_log(T[first, :3, :3].swapaxes(1, 2) @ T[first + 1, :3, :3]) / span
    strength = np.linalg.svd(rates - rates.mean(axis=0), compute_uv=False) / np.sqrt(len(rates))
    if strength[1] < _LEAST_RATE:
        raise DataError(
            f"the rig turned by {strength[0]:.2f} rad/s rms about one axis and {strength[1]:.2f} about the "
            f"next, {_LEAST_RATE} are needed: nod, roll and look around"
        )
    turned = _Turned(imu)
    lags = np.arange(-within_s, within_s + _LAG_S / 2, _LAG_S)
    ends = stamps_ns[first], stamps_ns[first + 1]
    score = np.array([_likeness(rates, turned.rates(*ends, lag))[0] for lag in lags])
    best = int(score.argmax())
    if score[best] < _LEAST_CORRELATION:
        raise MisfitError(
            f"camera and IMU turn nowhere alike (correlation {score[best]:.2f} of {_LEAST_CORRELATION} "
            f"needed, clocks up to {within_s:g} s apart): are both of one device, and the IMU in rad/s?"
        )
    shift = float(lags[best] + between_steps(score, best) * _LAG_S)
    gyro = turned.rates(*ends, shift)
    correlation, R = _likeness(rates, gyro)
    return Alignment(shift, R, gyro.mean(axis=0) - R @ rates.mean(axis=0), correlation)


class _Turned:
    """The gyro's rates, averaged between any two times."""

    def __init__(self, imu: ImuBatch) -> None:
        self._start = imu.stamps_ns[0]
        self._t = (imu.stamps_ns - self._start) * 1e-9
        steps = (imu.gyro[1:] + imu.gyro[:-1]) / 2 * np.diff(self._t)[:, None]
        self._sum = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def rates(self, from_ns: I64, to_ns: I64, shift_s: float) -> F64:
        """(N, 3) rad/s from stamps to stamps (N,), both shifted."""
        a, b = ((stamps - self._start) * 1e-9 + shift_s for stamps in (from_ns, to_ns))
        turn = [np.interp(b, self._t, one) - np.interp(a, self._t, one) for one in self._sum.T]
        return np.asarray(np.stack(turn, axis=1) / (b - a)[:, None], np.float64)


def _likeness(camera: F64, gyro: F64) -> tuple[float, F64]:
    """Correlation of rates (N, 3) where the camera's are turned best, and that rotation (3, 3)."""
    a, b = camera - camera.mean(axis=0), gyro - gyro.mean(axis=0)
    R = rotation(b.T @ a)
    return float((b * (a @ R.T)).sum() / np.sqrt((a * a).sum() * (b * b).sum() + 1e-300)), R


def first_state(stamps_ns: I64, T: F64, imu: ImuBatch, found: Alignment) -> State:
    """Knots by straight lines between the poses T (F, 4, 4) of cam0, which begins at the IMU's own place."""
    shifted: I64 = stamps_ns + round(found.shift_s * 1e9)
    begin = max(int(shifted[0]) - round(2 * EDGE_S * 1e9), int(imu.stamps_ns[0]))
    end = min(int(shifted[-1]) + round(2 * EDGE_S * 1e9), int(imu.stamps_ns[-1]))
    segments = int((end - begin) * 1e-9 / STEP_S)
    if segments * STEP_S < 1:
        raise DataError("IMU and pictures of the board have less than a second in common")
    at: F64 = (
        np.arange(segments + EDGE, dtype=np.float64) - (EDGE - 1) / 2
    ) * STEP_S  # where each weighs most
    t = np.asarray((shifted - begin) * 1e-9, np.float64)
    R = _between(t, T[:, :3, :3] @ found.R_imu_cam0.T, at)
    p = np.stack([np.interp(at, t, column) for column in T[:, :3, 3].T], axis=1)
    curve = Curve(begin, STEP_S, R, p)
    felt = np.stack([np.interp(t, (imu.stamps_ns - begin) * 1e-9, a) for a in imu.accel.T], axis=1)
    up = np.einsum("nij,nj->ni", T[:, :3, :3] @ found.R_imu_cam0.T, felt).mean(axis=0)
    per_node = round(NODE_S / STEP_S)
    biases = np.tile(np.append(found.gyro_bias, np.zeros(3)), (nodes(segments, per_node), 1))
    mount = se3.compose(found.R_imu_cam0, np.zeros(3))
    return State(curve, biases, per_node, mount, found.shift_s, -up)


def _between(t: F64, R: F64, at: F64) -> F64:
    """Rotations (K, 3, 3) at times (K,), from R (N, 3, 3) at t (N,) rising."""
    from scipy.spatial.transform import Rotation, Slerp

    return np.asarray(Slerp(t, Rotation.from_matrix(R))(np.clip(at, t[0], t[-1])).as_matrix(), np.float64)
