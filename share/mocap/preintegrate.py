"""IMU preintegration over many intervals at once: what the body did, free of where it stood and how fast.

Rate and specific force are linear between samples; each step is a midpoint rule. Source: Forster,
Carlone, Dellaert, Scaramuzza, *On-Manifold Preintegration for Real-Time Visual-Inertial Odometry*,
TRO 33(1), 2017, eq. 33-38 (increments), 44-45 (derivatives by the bias), 63 (noise).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.types import F64, I64, ImuBatch


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
