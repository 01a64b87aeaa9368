"""From IMU samples to motion: means, transition and noise of one interval, in closed form.

Under the error of `share.estimator.inertial.state` the transition knows the means only where biases
enter, so it is sums over the samples, not a product of matrices. Source: Barrau & Bonnabel (2017);
derived in docs/vio.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.types import F64, ImuBatch

_SIDE = 15  # pose, velocity, biases


@dataclass(frozen=True, eq=False)
class Motion:
    """At the end of the interval: T (4, 4), v (3,), bias-free rate (3,) rad/s in the body. transition,
    noise (15, 15) of the errors of pose, velocity and biases."""

    T: F64
    v: F64
    rate: F64
    transition: F64
    noise: F64


def integrate(
    T: F64, v: F64, bg: F64, ba: F64, imu: ImuBatch, from_ns: int, to_ns: int, noise: ImuNoise, gravity: float
) -> Motion:
    """Motion over (from_ns, to_ns) by the trapezoidal rule. imu: samples about the interval, in order; the
    first and last are held where they do not reach its ends. Raises ValueError without any."""
    dt, gyro, accel = _intervals(imu, from_ns, to_ns)
    gyro, accel = gyro - bg, accel - ba
    turns = gyro * dt[:, None]
    steps = se3.so3_exp(np.concatenate([turns, turns / 2]))
    R = _rotations(T[:3, :3], steps[: len(dt)])
    middle = R[:-1] @ steps[len(dt) :]
    g = np.array([0.0, 0.0, -gravity])
    a = (middle @ accel[:, :, None])[:, :, 0] + g
    v_at = v + _sums(a * dt[:, None])
    p_at = T[:3, 3] + _sums(v_at[:-1] * dt[:, None] + a * (dt**2 / 2)[:, None])
    v_mid, p_mid = (v_at[1:] + v_at[:-1]) / 2, (p_at[1:] + p_at[:-1]) / 2
    left = dt.sum() - (np.cumsum(dt) - dt / 2)  # from the middle of each part to the end
    gyro_effect, accel_effect = _effects(middle, v_mid, p_mid, left, se3.hat(g))
    return Motion(
        se3.compose(R[-1], p_at[-1]),
        v_at[-1],
        gyro[-1],
        _transition(gyro_effect, accel_effect, dt, se3.hat(g)),
        _noise(gyro_effect, accel_effect, dt, noise),
    )


def _intervals(imu: ImuBatch, from_ns: int, to_ns: int) -> tuple[F64, F64, F64]:
    """dt (N,) s between the samples inside, and both ends; mean rate and force (N, 3) over each."""
    if len(imu) == 0:
        raise ValueError("imu: no samples")
    seconds = (imu.stamps_ns - from_ns) * 1e-9
    length = (to_ns - from_ns) * 1e-9
    inside = seconds[(seconds > 0) & (seconds < length)]
    at = np.concatenate([[0.0], inside, [length]])
    values = np.concatenate([imu.gyro, imu.accel], axis=1)
    after = np.searchsorted(seconds, at).clip(1, max(len(seconds) - 1, 1)) if len(seconds) > 1 else None
    if after is None:
        ends = np.repeat(values, len(at), axis=0)
    else:
        t0, t1 = seconds[after - 1], seconds[after]
        share = ((at - t0) / np.maximum(t1 - t0, 1e-9)).clip(0, 1)[:, None]
        ends = values[after - 1] * (1 - share) + values[after] * share
    means = (ends[1:] + ends[:-1]) / 2
    return np.diff(at), means[:, :3], means[:, 3:]


def _rotations(R: F64, steps: F64) -> F64:
    """R and what it becomes by each of the steps (N, 3, 3): (N + 1, 3, 3)."""
    out = np.empty((len(steps) + 1, 3, 3))
    out[0] = R
    for k, step in enumerate(steps):
        np.matmul(out[k], step, out=out[k + 1])
    return out


def _sums(steps: F64) -> F64:
    """0 and the running sums of (N, 3): (N + 1, 3)."""
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def _effects(R: F64, v: F64, p: F64, left: F64, g: F64) -> tuple[F64, F64]:
    """What an impulse of gyro and of accel error in each part does to (phi, rho, nu) at the end, (N, 9, 3).

    phi' = -R w; rho' = nu - [p] R w; nu' = [g] phi - [v] R w - R a; the rest of the way is phi = const,
    nu = [g] phi t, rho = nu t + [g] phi t^2 / 2.
    """
    t = left[:, None, None]
    turn, shift, kick = -R, -se3.hat(p) @ R, -se3.hat(v) @ R
    pull = g @ turn
    by_gyro = np.concatenate([turn, shift + kick * t + pull * t**2 / 2, kick + pull * t], axis=1)
    by_accel = np.concatenate([np.zeros_like(R), -R * t, -R], axis=1)
    return by_gyro, by_accel


def _transition(gyro_effect: F64, accel_effect: F64, dt: F64, g: F64) -> F64:
    T = float(dt.sum())
    out = np.eye(_SIDE)
    out[3:6, 0:3], out[6:9, 0:3] = g * T**2 / 2, g * T
    out[3:6, 6:9] = T * np.eye(3)
    out[:9, 9:12] = np.einsum("n,nij->ij", dt, gyro_effect)
    out[:9, 12:15] = np.einsum("n,nij->ij", dt, accel_effect)
    return out


def _noise(gyro_effect: F64, accel_effect: F64, dt: F64, imu: ImuNoise) -> F64:
    T = float(dt.sum())
    weighted = (
        np.concatenate([imu.gyro_density * gyro_effect, imu.accel_density * accel_effect], axis=2)
        * np.sqrt(dt)[:, None, None]
    )
    flat = weighted.transpose(1, 0, 2).reshape(9, -1)
    out = np.zeros((_SIDE, _SIDE))
    out[:9, :9] = flat @ flat.T
    out[9:12, 9:12] = imu.gyro_walk**2 * T * np.eye(3)
    out[12:15, 12:15] = imu.accel_walk**2 * T * np.eye(3)
    return out
