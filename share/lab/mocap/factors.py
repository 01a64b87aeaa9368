"""The two kinds of measurement, linearised at a state: the IMU between nodes, the mocap at its own times.

Residuals are divided by their noise. Sources: Forster et al. 2017, eq. 45 and 69 (IMU); the mocap's
is that of hand-eye calibration with a common time offset (Furgale et al., *Unified Temporal and
Spatial Calibration*, IROS 2013), written for nodes instead of splines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.lab.mocap.state import NODE, SHARED, State
from share.types import F64, I64, ImuBatch


@dataclass(frozen=True, eq=False)
class Chain:
    """IMU residuals between nodes: whitened (M, 15) and their derivatives by the node before and after
    (M, 15, 15). raw (M, 9) and cov (M, 9, 9): rotation rad, position m, velocity m/s."""

    residual: F64
    by_before: F64
    by_after: F64
    raw: F64
    cov: F64

    def without(self, broken: np.ndarray) -> Chain:
        """Only intervals that the IMU joins."""
        fields = (self.residual, self.by_before, self.by_after, self.raw, self.cov)
        return Chain(*(field[~broken] for field in fields))


@dataclass(frozen=True, eq=False)
class Sightings:
    """Mocap residuals (K, 6), rotation then position, by their sigma; derivatives by the node before
    (K, 6, 15) and by the shared unknowns (K, 6, 10). node (K,): index of that node."""

    residual: F64
    by_node: F64
    by_shared: F64
    node: I64


def gravity_vector(gravity: float) -> F64:
    return np.array([0.0, 0.0, -gravity])


def imu_chain(state: State, imu: ImuBatch, noise: ImuNoise, gravity: float, broken: np.ndarray) -> Chain:
    """Residuals of consecutive nodes. broken (N - 1,) bool: no IMU across; only the biases walk on."""
    t = state.stamps_ns
    end = np.where(broken, t[:-1] + 1, t[1:])  # nothing to integrate across a break
    inc = preintegrate(imu, t[:-1], end, state.gyro_bias[:-1], state.accel_bias[:-1], noise)
    raw, before, after = _imu_residual(state, inc, gravity_vector(gravity))
    cov = inc.cov + np.eye(9) * 1e-14  # what midpoint steps cannot resolve
    white = np.linalg.inv(np.linalg.cholesky(cov))
    white[broken] = 0.0
    out = np.zeros((len(raw), NODE))
    J0, J1 = np.zeros((len(raw), NODE, NODE)), np.zeros((len(raw), NODE, NODE))
    out[:, :9] = (white @ raw[..., None])[..., 0]
    J0[:, :9], J1[:, :9] = white @ before, white @ after
    walk = np.repeat([noise.gyro_walk, noise.accel_walk], 3) * np.sqrt(np.diff(t) * 1e-9)[:, None]
    biases = np.concatenate([state.gyro_bias, state.accel_bias], axis=1)
    out[:, 9:] = np.diff(biases, axis=0) / walk
    J1[:, 9:, 9:] = np.eye(6) / walk[..., None]
    J0[:, 9:, 9:] = -J1[:, 9:, 9:]
    return Chain(out, J0, J1, raw, cov)


def _imu_residual(state: State, inc: Increments, g: F64) -> tuple[F64, F64, F64]:
    """(M, 9) and its derivatives (M, 9, 15) by the node before and the node after."""
    t = inc.dt[:, None]
    R0, R1 = state.R[:-1], state.R[1:]
    back = R0.swapaxes(1, 2)
    moved = _turn(back, state.p[1:] - state.p[:-1] - state.v[:-1] * t - g * t**2 / 2)
    sped = _turn(back, state.v[1:] - state.v[:-1] - g * t)
    turn = se3.so3_log(inc.dR.swapaxes(1, 2) @ back @ R1)
    Jinv = np.linalg.inv(se3.so3_right_jacobian(turn))
    before, after = np.zeros((len(t), 9, NODE)), np.zeros((len(t), 9, NODE))
    before[:, :3, :3], after[:, :3, :3] = -Jinv @ R1.swapaxes(1, 2) @ R0, Jinv
    before[:, 3:6, :3], before[:, 6:, :3] = se3.hat(moved), se3.hat(sped)
    before[:, 3:6, 3:6], after[:, 3:6, 3:6] = -back, back
    before[:, 3:6, 6:9] = -back * t[..., None]
    before[:, 6:, 6:9], after[:, 6:, 6:9] = -back, back
    before[:, :, 9:] = -inc.by_bias
    before[:, :3, 9:] = -Jinv @ se3.so3_exp(-turn) @ inc.by_bias[:, :3]
    return np.concatenate([turn, moved - inc.dp, sped - inc.dv], axis=1), before, after


def sightings(
    state: State, imu: ImuBatch, gravity: float, stamps_ns: I64, T_mocap: F64, sigma: F64
) -> Sightings:
    """Residuals of mocap poses T_mocap (K, 4, 4) at stamps_ns (K,) + the offset, which must lie within
    the nodes. sigma (6,): rad, m. Each is tied to the node before it by the IMU between them."""
    at = state.in_imu_clock(stamps_ns)
    i = np.clip(np.searchsorted(state.stamps_ns, at, "right") - 1, 0, len(state.p) - 2)
    inc = preintegrate(imu, state.stamps_ns[i], at, state.gyro_bias[i], state.accel_bias[i])
    t, g = inc.dt[:, None], gravity_vector(gravity)
    R = state.R[i] @ inc.dR
    p = state.p[i] + state.v[i] * t + g * t**2 / 2 + _turn(state.R[i], inc.dp)
    v = state.v[i] + g * t + _turn(state.R[i], inc.dv)
    R_wl, R_bm, arm = state.R_mocap_world, state.T_body_mocap[:3, :3], state.T_body_mocap[:3, 3]
    marker = p + R @ arm  # the mocap body's origin, levelled world
    turn = se3.so3_log(T_mocap[:, :3, :3].swapaxes(1, 2) @ R_wl @ R @ R_bm)
    Jinv = np.linalg.inv(se3.so3_right_jacobian(turn))
    residual = np.concatenate([turn, marker @ R_wl.T - T_mocap[:, :3, 3]], axis=1)

    body = np.zeros((len(t), 3, NODE))  # how the node turns the body at the sample's time
    body[:, :, :3] = inc.dR.swapaxes(1, 2)
    body[:, :, 9:] = inc.by_bias[:, :3]
    lever = -R @ se3.hat(arm)
    J = np.zeros((len(t), 6, NODE))
    J[:, :3] = Jinv @ R_bm.T @ body
    J[:, 3:, :3] = -state.R[i] @ se3.hat(inc.dp)
    J[:, 3:, 3:6], J[:, 3:, 6:9] = np.eye(3), np.eye(3) * t[..., None]
    J[:, 3:, 9:] = state.R[i] @ inc.by_bias[:, 3:6]
    J[:, 3:] = R_wl @ (J[:, 3:] + lever @ body)
    S = np.zeros((len(t), 6, SHARED))
    tilt = se3.so3_right_jacobian(np.append(state.tilt, 0.0))[:, :2]
    S[:, :3, :2] = Jinv @ (R @ R_bm).swapaxes(1, 2) @ tilt
    S[:, :3, 2:5] = Jinv
    S[:, :3, 8] = _turn(Jinv @ R_bm.T, inc.rate_end)
    S[:, 3:, :2] = -R_wl @ se3.hat(marker) @ tilt
    S[:, 3:, 5:8] = R_wl @ R @ R_bm
    S[:, 3:, 8] = (v + _turn(lever, inc.rate_end)) @ R_wl.T
    S[:, :, 9] = S[:, :, 8] * (stamps_ns - state.middle_ns)[:, None] * 1e-9
    return Sightings(residual / sigma, J / sigma[:, None], S / sigma[:, None], i)


def _turn(R: F64, v: F64) -> F64:
    """R (N, 3, 3) times v (N, 3)."""
    out: F64 = (R @ v[..., None])[..., 0]
    return out


# ---- IMU preintegration over many intervals at once: what the body did, free of where it stood and how
# fast.
#
# Rate and specific force are linear between samples; each step is a midpoint rule. Source: Forster, Carlone,
# Dellaert, Scaramuzza, *On-Manifold Preintegration for Real-Time Visual-Inertial Odometry*, TRO 33(1), 2017,
# eq. 33-38 (increments), 44-45 (derivatives by the bias), 63 (noise).


@dataclass(frozen=True, eq=False)
class Increments:
    """Motion over N intervals as its IMU saw it: dt (N,) s; dR (N, 3, 3), dp (N, 3) m, dv (N, 3) m/s
    in the body frame at the interval's start, gravity left out.

    by_bias (N, 9, 6): derivative of (rotation at the right of dR, dp, dv) by (gyro, accel bias).
    cov (N, 9, 9): covariance of the same nine by the IMU's white noise.
    rate_end (N, 3): rad/s, bias-free, at the end of each interval.
    """

    dt: F64
    dR: F64
    dp: F64
    dv: F64
    by_bias: F64
    cov: F64
    rate_end: F64


def preintegrate(
    imu: ImuBatch, start_ns: I64, end_ns: I64, gyro_bias: F64, accel_bias: F64, noise: ImuNoise | None = None
) -> Increments:
    """Increments over [start_ns, end_ns] (N,), each within the samples, with biases (N, 3) taken off.

    Without `noise` the covariance stays zero (and costs nothing).
    """
    stamps, step = _grid(imu.stamps_ns, start_ns, end_ns)
    gyro = sampled(imu, stamps, imu.gyro) - gyro_bias[:, None]
    accel = sampled(imu, stamps, imu.accel) - accel_bias[:, None]
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
        A, B = _linearised(dR, half, w, a, t)
        D = A @ D + B
        if noise is not None:
            P = A @ P @ A.swapaxes(1, 2) + _noise(B, t, noise)
        dp = dp + dv * t + a_start[..., 0] * t**2 / 2
        dv = dv + a_start[..., 0] * t
        dR = dR @ half @ half
    dt: F64 = (end_ns - start_ns).astype(np.float64) * 1e-9
    return Increments(dt, dR, dp, dv, D, P, gyro[:, -1])


def sampled(imu: ImuBatch, stamps_ns: I64, values: F64) -> F64:
    """A column block (S, 3) of `imu`, linear between samples, at stamps (...,) -> (..., 3)."""
    origin = imu.stamps_ns[0]  # floats hold nanoseconds since the start, not since 1970
    at, own = (stamps_ns - origin).astype(float), (imu.stamps_ns - origin).astype(float)
    return np.stack([np.interp(at, own, values[:, i]) for i in range(3)], axis=-1)


def _grid(samples_ns: I64, start_ns: I64, end_ns: I64) -> tuple[I64, F64]:
    """Start, the samples within, end of every interval, padded by repeating the end: (N, K + 1) ns,
    and the steps between (N, K) s. A step of 0 s changes nothing."""
    first = np.searchsorted(samples_ns, start_ns, "right")
    inside = np.searchsorted(samples_ns, end_ns, "left") - first
    k = np.arange(max(0, int(inside.max(initial=0))))
    at = samples_ns[np.minimum(first[:, None] + k, len(samples_ns) - 1)]
    middle = np.where(k < inside[:, None], at, end_ns[:, None])
    stamps = np.concatenate([start_ns[:, None], middle, end_ns[:, None]], axis=1)
    return stamps, np.diff(stamps, axis=1) * 1e-9


def _linearised(dR: F64, half: F64, w: F64, a: F64, t: F64) -> tuple[F64, F64]:
    """One step's derivatives by (rotation, p, v) before it, (N, 9, 9), and by the biases, (N, 9, 6)."""
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


def _noise(B: F64, t: F64, noise: ImuNoise) -> F64:
    """What white noise adds in one step: a mean over t has variance density^2 / t."""
    density = np.repeat([noise.gyro_density, noise.accel_density], 3) ** 2
    per_step = density / np.where(t > 0, t, 1.0)
    return np.asarray((B * per_step[:, None]) @ B.swapaxes(1, 2), np.float64)
