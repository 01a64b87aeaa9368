"""Normal equations of corners and IMU, segment by segment of the curve."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from share.geometry import se3
from share.lab.calibrate.camera_bundle import shared
from share.lab.calibrate.camera_imu.sights import Sights, pose_normal, rig_normal
from share.lab.calibrate.camera_imu.spline import ORDER, Curve
from share.lab.calibrate.camera_imu.state import GRAVITY, KNOTS, LOCAL, MOUNT, SHARED, SHIFT, State, twist
from share.types import F64, I64, ImuBatch

_SHARED = slice(KNOTS, KNOTS + SHARED)


@dataclass(frozen=True)
class Sigmas:
    """Of a corner's coordinate px, of a sample rad/s and m/s^2. huber: times px, where doubt begins."""

    px: float
    gyro: float
    accel: float
    huber: float = 2.5


@dataclass(frozen=True, eq=False)
class Normal:
    """Of S segments H (S, L, L) and g (S, L) by their own columns (LOCAL), and the whole cost."""

    H: F64
    g: F64
    cost: float


def normal(state: State, sights: Sights, imu: ImuBatch, sigmas: Sigmas) -> Normal:
    """At a state. The cost is infinite where a corner would lie behind its camera."""
    segments = state.curve.segments
    out = Normal(np.zeros((segments, LOCAL, LOCAL)), np.zeros((segments, LOCAL)), 0.0)
    cost = _add_sights(out, state, sights, sigmas) + _add_imu(out, state, imu, sigmas)
    return Normal(out.H, out.g, cost)


def poses(state: State, stamps_ns: I64) -> F64:
    """T_target_cam0 (F, 4, 4) at stamps (F,) of the camera's clock."""
    at = state.curve.place(stamps_ns, state.shift_s)
    return se3.compose(state.curve.turning(at).R, state.curve.position(at)[0]) @ state.T_imu_cam0


def pose_derivatives(state: State, stamps_ns: I64) -> tuple[F64, F64, I64]:
    """T_target_cam0 (F, 4, 4), its eta by local columns (F, 6, LOCAL), and the segments (F,)."""
    curve, at = state.curve, state.curve.place(stamps_ns, state.shift_s)
    turning, (p, weight) = curve.turning(at), curve.position(at)
    J = np.zeros((len(at.u), 6, LOCAL))
    knots = J[..., :KNOTS].reshape(len(at.u), 6, ORDER, 6)  # a view
    knots[:, :3, :, :3] = turning.by.transpose(0, 2, 1, 3)
    knots[:, 3:, :, 3:] = turning.R.swapaxes(1, 2)[:, :, None] * weight[:, None, :, None]
    J[:, :, KNOTS + SHIFT] = twist(turning.R, turning.rate, curve.position(at, 1)[0])
    J = se3.adjoint(se3.inverse(state.T_imu_cam0)) @ J
    J[:, :, _SHARED][:, :, MOUNT] = np.eye(6)
    return se3.compose(turning.R, p) @ state.T_imu_cam0, J, at.segment


def _add_sights(out: Normal, state: State, sights: Sights, sigmas: Sigmas) -> float:
    T, J, segment = pose_derivatives(state, sights.stamps_ns)
    frames = pose_normal(sights, T, sigmas.px, sigmas.huber)
    np.add.at(out.H, segment, J.swapaxes(1, 2) @ frames.H @ J)
    np.add.at(out.g, segment, (J.swapaxes(1, 2) @ frames.g[..., None])[..., 0])
    return frames.cost


def rig_sensitivity(state: State, sights: Sights, sigmas: Sigmas) -> F64:
    """By how much each segment's gradient (S, LOCAL) falls with the rig's own parameters, (S, LOCAL, P):
    intrinsics and T_cam1_cam0, which are not sought."""
    T, J, segment = pose_derivatives(state, sights.stamps_ns)
    out: F64 = np.zeros((state.curve.segments, LOCAL, shared(sights.cameras)))
    np.add.at(out, segment, J.swapaxes(1, 2) @ rig_normal(sights, T, sigmas.px, sigmas.huber))
    return out


def inertial(state: State, imu: ImuBatch) -> tuple[F64, F64, I64]:
    """Residuals (N, 6) of gyro and accel, measured less predicted, the derivatives (N, 6, LOCAL) of what is
    predicted, and the segments (N,)."""
    curve, at = state.curve, state.curve.place(imu.stamps_ns)
    turning, (a, weight) = curve.turning(at), curve.position(at, 2)
    bias, after = state.bias(at.segment, at.u)
    back = turning.R.swapaxes(1, 2)
    force = (back @ (a - state.gravity)[..., None])[..., 0]
    J = np.zeros((len(at.u), 6, LOCAL))
    knots = J[..., :KNOTS].reshape(len(at.u), 6, ORDER, 6)
    knots[:, :3, :, :3] = turning.rate_by.transpose(0, 2, 1, 3)
    knots[:, 3:, :, :3] = (se3.hat(force)[:, None] @ turning.by).transpose(0, 2, 1, 3)
    knots[:, 3:, :, 3:] = back[:, :, None] * weight[:, None, :, None]
    J[:, 3:, _SHARED][:, :, GRAVITY] = -back
    J[:, :, -12:-6] = np.eye(6) * (1 - after)[:, None, None]
    J[:, :, -6:] = np.eye(6) * after[:, None, None]
    predicted = np.concatenate([turning.rate, force], axis=1) + bias
    return np.concatenate([imu.gyro, imu.accel], axis=1) - predicted, J, at.segment


def _add_imu(out: Normal, state: State, imu: ImuBatch, sigmas: Sigmas) -> float:
    r, J, segment = inertial(state, imu)
    sigma = np.repeat([sigmas.gyro, sigmas.accel], 3)
    r, J = r / sigma, J / sigma[:, None]
    ends = np.searchsorted(segment, np.arange(state.curve.segments + 1))
    for k, (first, last) in enumerate(pairwise(ends)):
        A = J[first:last].reshape(-1, LOCAL)
        out.H[k] += A.T @ A
        out.g[k] += A.T @ r[first:last].reshape(-1)
    return float((r**2).sum() / 2)


def covers(curve: Curve, stamps_ns: I64, shift_s: float, margin_s: float) -> np.ndarray:
    """Which stamps (N,), shifted, lie on the curve with a margin to its ends."""
    t = (stamps_ns - curve.start_ns) * 1e-9 + shift_s
    return np.asarray((t >= margin_s) & (t <= curve.end_s - margin_s))
