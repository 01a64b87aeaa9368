"""Linearised factors: IMU preintegration between nodes, and mocap poses at their own times.

Residuals are divided by their noise. Sources: Forster et al. 2017, eq. 45 and 69 (IMU); the mocap factor is
hand-eye calibration with a common time offset (Furgale et al., *Unified Temporal and Spatial Calibration*,
IROS 2013), for nodes instead of splines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.lab.mocap.state import NODE_SIZE, SHARED_SIZE, MocapImuState
from share.types import F64, I64, ImuBatch


@dataclass(frozen=True, eq=False)
class ImuChain:
    """IMU residuals between nodes: whitened (M, 15) and their derivatives by the node before and after (M,
    15, 15). raw (M, 9) and cov (M, 9, 9): rotation rad, position m, velocity m/s."""

    residual: F64
    jacobian_before: F64
    jacobian_after: F64
    raw: F64
    cov: F64


@dataclass(frozen=True, eq=False)
class MocapObservations:
    """Mocap residuals (K, 6), rotation then position, over their sigma; derivatives by the node before (K,
    6, 15) and by the shared unknowns (K, 6, 10). node (K,): index of that node."""

    residual: F64
    jacobian_node: F64
    jacobian_shared: F64
    node: I64


def gravity_vector(gravity: float) -> F64:
    return np.array([0.0, 0.0, -gravity])


def imu_chain(
    state: MocapImuState, imu: ImuBatch, noise: ImuNoise, gravity: float, is_break: np.ndarray
) -> ImuChain:
    """Return residuals of consecutive nodes. is_break (N - 1,) bool: no IMU across; only the biases'
    random walk."""
    t = state.stamps_ns
    end = np.where(is_break, t[:-1] + 1, t[1:])  # nothing to integrate across a break
    inc = preintegrate(imu, t[:-1], end, state.gyro_bias[:-1], state.accel_bias[:-1], noise)
    raw, before, after = _imu_residual(state, inc, gravity_vector(gravity))
    cov = inc.cov + np.eye(9) * 1e-14  # integration error of midpoint steps
    whitening = np.linalg.inv(np.linalg.cholesky(cov))
    whitening[is_break] = 0.0
    out = np.zeros((len(raw), NODE_SIZE))
    J0, J1 = np.zeros((len(raw), NODE_SIZE, NODE_SIZE)), np.zeros((len(raw), NODE_SIZE, NODE_SIZE))
    out[:, :9] = (whitening @ raw[..., None])[..., 0]
    J0[:, :9], J1[:, :9] = whitening @ before, whitening @ after
    walk = np.repeat([noise.gyro_walk, noise.accel_walk], 3) * np.sqrt(np.diff(t) * 1e-9)[:, None]
    biases = np.concatenate([state.gyro_bias, state.accel_bias], axis=1)
    out[:, 9:] = np.diff(biases, axis=0) / walk
    J1[:, 9:, 9:] = np.eye(6) / walk[..., None]
    J0[:, 9:, 9:] = -J1[:, 9:, 9:]
    return ImuChain(out, J0, J1, raw, cov)


def _imu_residual(state: MocapImuState, inc: PreintegratedImu, g: F64) -> tuple[F64, F64, F64]:
    """Return residuals (M, 9) and their derivatives (M, 9, 15) by the node before and the node after."""
    t = inc.dt[:, None]
    R0, R1 = state.R[:-1], state.R[1:]
    R0_transposed = R0.swapaxes(1, 2)
    position_change = _rotate(R0_transposed, state.p[1:] - state.p[:-1] - state.v[:-1] * t - g * t**2 / 2)
    velocity_change = _rotate(R0_transposed, state.v[1:] - state.v[:-1] - g * t)
    turn = se3.so3_log(inc.dR.swapaxes(1, 2) @ R0_transposed @ R1)
    Jinv = np.linalg.inv(se3.so3_right_jacobian(turn))
    before, after = np.zeros((len(t), 9, NODE_SIZE)), np.zeros((len(t), 9, NODE_SIZE))
    before[:, :3, :3], after[:, :3, :3] = -Jinv @ R1.swapaxes(1, 2) @ R0, Jinv
    before[:, 3:6, :3], before[:, 6:, :3] = se3.hat(position_change), se3.hat(velocity_change)
    before[:, 3:6, 3:6], after[:, 3:6, 3:6] = -R0_transposed, R0_transposed
    before[:, 3:6, 6:9] = -R0_transposed * t[..., None]
    before[:, 6:, 6:9], after[:, 6:, 6:9] = -R0_transposed, R0_transposed
    before[:, :, 9:] = -inc.bias_jacobian
    before[:, :3, 9:] = -Jinv @ se3.so3_exp(-turn) @ inc.bias_jacobian[:, :3]
    return np.concatenate([turn, position_change - inc.dp, velocity_change - inc.dv], axis=1), before, after


def mocap_observations(
    state: MocapImuState, imu: ImuBatch, gravity: float, stamps_ns: I64, T_mocap: F64, sigma: F64
) -> MocapObservations:
    """Return residuals of mocap poses T_mocap (K, 4, 4) at stamps_ns (K,) + offset, which must lie within
    the nodes. sigma (6,): rad, m. Each is predicted by the IMU from the node before it."""
    imu_stamps = state.in_imu_clock(stamps_ns)
    i = np.clip(np.searchsorted(state.stamps_ns, imu_stamps, "right") - 1, 0, len(state.p) - 2)
    inc = preintegrate(imu, state.stamps_ns[i], imu_stamps, state.gyro_bias[i], state.accel_bias[i])
    t = inc.dt[:, None]
    R, p, v = propagate(state.R[i], state.p[i], state.v[i], inc, gravity)
    R_wl, R_bm, arm = state.R_mocap_world, state.T_body_mocap[:3, :3], state.T_body_mocap[:3, 3]
    marker = p + R @ arm  # the mocap body's origin, levelled world
    turn = se3.so3_log(T_mocap[:, :3, :3].swapaxes(1, 2) @ R_wl @ R @ R_bm)
    Jinv = np.linalg.inv(se3.so3_right_jacobian(turn))
    residual = np.concatenate([turn, marker @ R_wl.T - T_mocap[:, :3, 3]], axis=1)

    rotation_jacobian = np.zeros((len(t), 3, NODE_SIZE))  # of the body at the sample's time, by the node
    rotation_jacobian[:, :, :3] = inc.dR.swapaxes(1, 2)
    rotation_jacobian[:, :, 9:] = inc.bias_jacobian[:, :3]
    lever = -R @ se3.hat(arm)
    J = np.zeros((len(t), 6, NODE_SIZE))
    J[:, :3] = Jinv @ R_bm.T @ rotation_jacobian
    J[:, 3:, :3] = -state.R[i] @ se3.hat(inc.dp)
    J[:, 3:, 3:6], J[:, 3:, 6:9] = np.eye(3), np.eye(3) * t[..., None]
    J[:, 3:, 9:] = state.R[i] @ inc.bias_jacobian[:, 3:6]
    J[:, 3:] = R_wl @ (J[:, 3:] + lever @ rotation_jacobian)
    S = np.zeros((len(t), 6, SHARED_SIZE))
    tilt = se3.so3_right_jacobian(np.append(state.tilt, 0.0))[:, :2]
    S[:, :3, :2] = Jinv @ (R @ R_bm).swapaxes(1, 2) @ tilt
    S[:, :3, 2:5] = Jinv
    S[:, :3, 8] = _rotate(Jinv @ R_bm.T, inc.rate_end)
    S[:, 3:, :2] = -R_wl @ se3.hat(marker) @ tilt
    S[:, 3:, 5:8] = R_wl @ R @ R_bm
    S[:, 3:, 8] = (v + _rotate(lever, inc.rate_end)) @ R_wl.T
    S[:, :, 9] = S[:, :, 8] * (stamps_ns - state.middle_ns)[:, None] * 1e-9
    return MocapObservations(residual / sigma, J / sigma[:, None], S / sigma[:, None], i)


def propagate(R: F64, p: F64, v: F64, inc: PreintegratedImu, gravity: float) -> tuple[F64, F64, F64]:
    """Return rotations (N, 3, 3), positions and velocities (N, 3) after the preintegrated motions `inc`."""
    t, g = inc.dt[:, None], gravity_vector(gravity)
    return R @ inc.dR, p + v * t + g * t**2 / 2 + _rotate(R, inc.dp), v + g * t + _rotate(R, inc.dv)


def _rotate(R: F64, v: F64) -> F64:
    """Return R (N, 3, 3) times v (N, 3)."""
    out: F64 = (R @ v[..., None])[..., 0]
    return out


# IMU preintegration over many intervals at once.
#
# Rate and specific force are linear between samples; each step is a midpoint rule. Source: Forster, Carlone,
# Dellaert, Scaramuzza, *On-Manifold Preintegration for Real-Time Visual-Inertial Odometry*, TRO 33(1), 2017,
# eq. 33-38 (increments), 44-45 (derivatives by the bias), 63 (noise).


@dataclass(frozen=True, eq=False)
class PreintegratedImu:
    """Preintegrated motion over N intervals: dt (N,) s; dR (N, 3, 3), dp (N, 3) m, dv (N, 3) m/s in the body
    frame at the interval's start, without gravity.

    bias_jacobian (N, 9, 6): derivative of (rotation on the right of dR, dp, dv) by (gyro, accel bias). cov
    (N, 9, 9): of the same nine by the IMU's white noise. rate_end (N, 3): rad/s, bias-free, at the end of
    each interval.
    """

    dt: F64
    dR: F64
    dp: F64
    dv: F64
    bias_jacobian: F64
    cov: F64
    rate_end: F64


def preintegrate(
    imu: ImuBatch, start_ns: I64, end_ns: I64, gyro_bias: F64, accel_bias: F64, noise: ImuNoise | None = None
) -> PreintegratedImu:
    """Preintegrate over [start_ns, end_ns] (N,), each within the samples, with biases (N, 3) subtracted.

    Without `noise` the covariance stays zero (and costs nothing).
    """
    stamps, step = _integration_grid(imu.stamps_ns, start_ns, end_ns)
    gyro = interpolate_samples(imu, stamps, imu.gyro) - gyro_bias[:, None]
    accel = interpolate_samples(imu, stamps, imu.accel) - accel_bias[:, None]
    n = len(start_ns)
    dR: F64 = np.tile(np.eye(3), (n, 1, 1))
    dp, dv = np.zeros((n, 3)), np.zeros((n, 3))
    D: F64 = np.zeros((n, 9, 6))
    P: F64 = np.zeros((n, 9, 9))
    for k in range(step.shape[1]):
        t = step[:, k, None]
        w, a = (gyro[:, k] + gyro[:, k + 1]) / 2, (accel[:, k] + accel[:, k + 1]) / 2
        half = se3.so3_exp(w * t / 2)
        a_start = dR @ half @ a[..., None]  # specific force, in the frame of the interval's start
        A, B = _linearise_step(dR, half, w, a, t)
        D = A @ D + B
        if noise is not None:
            P = A @ P @ A.swapaxes(1, 2) + _step_noise(B, t, noise)
        dp = dp + dv * t + a_start[..., 0] * t**2 / 2
        dv = dv + a_start[..., 0] * t
        dR = dR @ half @ half
    dt: F64 = (end_ns - start_ns).astype(np.float64) * 1e-9
    return PreintegratedImu(dt, dR, dp, dv, D, P, gyro[:, -1])


def interpolate_samples(imu: ImuBatch, stamps_ns: I64, values: F64) -> F64:
    """Interpolate values (S, 3) of `imu` linearly at stamps (...,): (..., 3)."""
    origin = imu.stamps_ns[0]  # floats are exact for nanoseconds since the start, not since 1970
    query_s, samples_s = (stamps_ns - origin).astype(float), (imu.stamps_ns - origin).astype(float)
    return np.stack([np.interp(query_s, samples_s, values[:, i]) for i in range(3)], axis=-1)


def _integration_grid(samples_ns: I64, start_ns: I64, end_ns: I64) -> tuple[I64, F64]:
    """Return start, the samples within, and end of every interval, padded by repeating the end: (N, K + 1)
    ns, and the steps between (N, K) s. A step of 0 s changes nothing."""
    first = np.searchsorted(samples_ns, start_ns, "right")
    inside = np.searchsorted(samples_ns, end_ns, "left") - first
    k = np.arange(max(0, int(inside.max(initial=0))))
    samples = samples_ns[np.minimum(first[:, None] + k, len(samples_ns) - 1)]
    middle = np.where(k < inside[:, None], samples, end_ns[:, None])
    stamps = np.concatenate([start_ns[:, None], middle, end_ns[:, None]], axis=1)
    return stamps, np.diff(stamps, axis=1) * 1e-9


def _linearise_step(dR: F64, half: F64, w: F64, a: F64, t: F64) -> tuple[F64, F64]:
    """Return one step's derivatives by (rotation, p, v) before it, (N, 9, 9), and by the biases, (N, 9,
    6)."""
    n, eye, t = len(dR), np.eye(3), t[..., None]
    push = dR @ half
    by_rotation = -dR @ se3.hat((half @ a[..., None])[..., 0]) * t
    by_gyro = push @ se3.hat(a) @ se3.so3_right_jacobian(w * t[..., 0] / 2) * t**2 / 2
    A = np.tile(np.eye(9), (n, 1, 1))
    A[:, :3, :3] = (half @ half).swapaxes(1, 2)
    A[:, 6:, :3], A[:, 3:6, :3] = by_rotation, by_rotation * t / 2
    A[:, 3:6, 6:] = eye * t
    B = np.zeros((n, 9, 6))
    B[:, :3, :3] = -se3.so3_right_jacobian(w * t[..., 0]) * t
    B[:, 6:, :3], B[:, 3:6, :3] = by_gyro, by_gyro * t / 2
    B[:, 6:, 3:], B[:, 3:6, 3:] = -push * t, -push * t**2 / 2
    return A, B


def _step_noise(B: F64, t: F64, noise: ImuNoise) -> F64:
    """Return the covariance that white noise adds in one step: a mean over t has variance density^2 / t."""
    density = np.repeat([noise.gyro_density, noise.accel_density], 3) ** 2
    per_step = density / np.where(t > 0, t, 1.0)
    return np.asarray((B * per_step[:, None]) @ B.swapaxes(1, 2), np.float64)
