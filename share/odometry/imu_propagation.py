"""Integrate IMU samples over one interval: means, transition and noise covariance, in closed form.

With the error of `share.odometry.state`, the transition depends on the means only through the biases, so it
is a sum over the samples, not a product of matrices. Source: Barrau & Bonnabel (2017); derived in
docs/understand/odometry.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.odometry.state import IMU_STATE_SIZE
from share.types import F64, ImuBatch


@dataclass(frozen=True, eq=False)
class ImuPropagation:
    """The end of the interval: T (4, 4), v (3,), bias-free rate (3,) rad/s in the body.

    transition, noise_cov (15, 15): of the errors of pose, velocity and biases.
    """

    T: F64
    v: F64
    rate: F64
    transition: F64
    noise_cov: F64


def integrate(
    T: F64, v: F64, bg: F64, ba: F64, imu: ImuBatch, from_ns: int, to_ns: int, noise: ImuNoise, gravity: float
) -> ImuPropagation:
    """Integrate over (from_ns, to_ns) by the trapezoidal rule.

    imu: samples about the interval, in order; the first and last are held where they do not reach its ends.
    Raises ValueError without samples.
    """
    dt, gyro, accel = _intervals(imu, from_ns, to_ns)
    gyro, accel, dt_column = gyro - bg, accel - ba, dt[:, None]
    half_turn = se3.so3_exp(gyro * (dt_column / 2))
    R = _cumulative_rotations(T[:3, :3], half_turn @ half_turn)
    middle = R[:-1] @ half_turn
    g = np.array([0.0, 0.0, -gravity])
    a = (middle @ accel[:, :, None])[:, :, 0] + g
    v_at = _cumulative_sums(v, a * dt_column)
    p_at = _cumulative_sums(T[:3, 3], v_at[:-1] * dt_column + a * (dt_column**2 / 2))
    v_mid, p_mid = (v_at[1:] + v_at[:-1]) / 2, (p_at[1:] + p_at[:-1]) / 2
    remaining = float(dt.sum()) - (np.cumsum(dt) - dt / 2)  # s, from the middle of each step to the end
    response = _impulse_responses(middle, v_mid, p_mid, remaining[:, None], g)
    return ImuPropagation(
        se3.from_rt(R[-1], p_at[-1]),
        v_at[-1],
        gyro[-1],
        _transition(response, dt, se3.hat(g)),
        _noise_cov(response, dt, noise),
    )


def _intervals(imu: ImuBatch, from_ns: int, to_ns: int) -> tuple[F64, F64, F64]:
    """Return the lengths dt (N,) s between the samples inside and both ends, and the mean rate and force
    (N, 3) of each."""
    if len(imu) == 0:
        raise ValueError("imu: no samples")
    seconds = (imu.stamps_ns - from_ns) * 1e-9
    length = (to_ns - from_ns) * 1e-9
    inside = seconds[(seconds > 0) & (seconds < length)]
    bounds = np.concatenate([[0.0], inside, [length]])
    values = np.concatenate([imu.gyro, imu.accel], axis=1)
    after = np.searchsorted(seconds, bounds).clip(1, max(len(seconds) - 1, 1)) if len(seconds) > 1 else None
    if after is None:
        ends = np.repeat(values, len(bounds), axis=0)
    else:
        t0, t1 = seconds[after - 1], seconds[after]
        fraction = ((bounds - t0) / np.maximum(t1 - t0, 1e-9)).clip(0, 1)[:, None]
        ends = values[after - 1] * (1 - fraction) + values[after] * fraction
    means = (ends[1:] + ends[:-1]) / 2
    return np.diff(bounds), means[:, :3], means[:, 3:]


def _cumulative_rotations(R: F64, steps: F64) -> F64:
    """Return R and its products with successive steps (N, 3, 3): (N + 1, 3, 3).

    By doubling: after k rounds each is the product of up to 2^k steps.
    """
    out, stride = np.concatenate([R[None], steps]), 1
    while stride < len(out):
        out[stride:] = out[:-stride] @ out[stride:]
        stride *= 2
    return out


def _cumulative_sums(first: F64, steps: F64) -> F64:
    """Return `first` (3,) and its sums with successive steps (N, 3): (N + 1, 3)."""
    return np.cumsum(np.concatenate([first[None], steps]), axis=0)


def _impulse_responses(R: F64, v: F64, p: F64, remaining: F64, g: F64) -> F64:
    """Return the derivatives (N, 9, 6) of the final (phi, rho, nu) by an impulse of gyro and accelerometer
    error in each step.

    phi' = -R w; rho' = nu - [p] R w; nu' = [g] phi - [v] R w - R a. In the remaining time (N, 1) s, phi =
    const, nu = [g] phi t, rho = nu t + [g] phi t^2 / 2: a rotation about the point where a body in free fall
    would then be.
    """
    falling = np.concatenate([p + v * remaining + g * (remaining**2 / 2), v + g * remaining])
    levers = se3.hat(falling).reshape(2, -1, 3, 3) @ R
    out = np.zeros((len(R), 9, 6))
    out[:, :3, :3], out[:, 3:6, :3], out[:, 6:, :3] = R, levers[0], levers[1]
    out[:, 3:6, 3:], out[:, 6:, 3:] = R * remaining[:, :, None], R
    return np.negative(out, out=out)


def _transition(response: F64, dt: F64, g: F64) -> F64:
    T = float(dt.sum())
    out = np.eye(IMU_STATE_SIZE)
    out[3:6, 0:3], out[6:9, 0:3] = g * (T**2 / 2), g * T
    out[3, 6] = out[4, 7] = out[5, 8] = T
    out[:9, 9:] = (dt @ response.reshape(-1, 54)).reshape(9, 6)
    return out


def _noise_cov(response: F64, dt: F64, imu: ImuNoise) -> F64:
    T = float(dt.sum())
    density = np.repeat([imu.gyro_density, imu.accel_density], 3)
    weighted = response * (np.sqrt(dt)[:, None, None] * density)
    flat = weighted.transpose(1, 0, 2).reshape(9, -1)
    out = np.zeros((IMU_STATE_SIZE, IMU_STATE_SIZE))
    out[:9, :9] = flat @ flat.T
    walks = np.arange(9, IMU_STATE_SIZE)
    out[walks, walks] = T * np.repeat([imu.gyro_walk**2, imu.accel_walk**2], 3)
    return out


# IMU noise: scaled, raised by vibration, and for axes without samples.

_BLOCK_LENGTHS_S = 0.005, 0.01, 0.015, 0.02  # blocks of samples whose means are compared
_DIFFERENCE_VARIANCE = 20.0  # variance of third differences of white noise, relative to its own


def scaled_noise(imu: ImuNoise, noise_scale: float) -> ImuNoise:
    """Return densities and walks times `noise_scale`."""
    return ImuNoise(
        imu.gyro_density * noise_scale,
        imu.accel_density * noise_scale,
        imu.gyro_walk * noise_scale,
        imu.accel_walk * noise_scale,
        imu.rate_hz,
    )


def noise_with_vibration(imu: ImuNoise, samples: ImuBatch) -> ImuNoise:
    """Return densities raised to those that the samples show.

    Vibration faster than the sampling is noise to the integration. A body's own motion is smooth: third
    differences of means over blocks of b seconds contain 20 times the variance of white noise, and of a
    motion of frequency f only (2 sin(pi f b))^6. White noise shows the same density for every b, vibration
    less for longer blocks, as its integral is smaller, motion more. So the minimum over the blocks is taken.
    """
    if len(samples) < 2:
        return imu
    step_s = (samples.stamps_ns[-1] - samples.stamps_ns[0]) * 1e-9 / (len(samples) - 1)
    sums = np.zeros((len(samples) + 1, 6))
    np.cumsum(np.concatenate([samples.gyro, samples.accel], axis=1), axis=0, out=sums[1:])
    densities = []  # squared
    for block in {max(1, round(block_s / step_s)) for block_s in _BLOCK_LENGTHS_S}:
        fourth = _fourth_differences(sums, block)  # of the sums: third differences of the means, times block
        if (count := len(fourth)) > block:
            densities.append(
                np.einsum("na,na->a", fourth, fourth) * (step_s / (_DIFFERENCE_VARIANCE * count * block))
            )
    if not densities:
        return imu
    density = np.sqrt(np.min(densities, axis=0))
    return replace(
        imu,
        gyro_density=max(imu.gyro_density, float(density[:3].max())),
        accel_density=max(imu.accel_density, float(density[3:].max())),
    )


def _fourth_differences(x: F64, by: int) -> F64:
    """Return the fourth differences (N - 4 by, 6) of x (N, 6), between rows `by` apart."""
    out = x
    for _ in range(4):
        out = out[by:] - out[:-by]
    return out


def noise_without_axes(imu: ImuNoise, constant_velocity: ImuNoise, axes: NDArray[np.bool_]) -> ImuNoise:
    """Return the noise with the densities of `constant_velocity` for the sensors that have an axis in
    `axes` (6,), gyro then accelerometer."""
    if not axes.any():
        return imu
    return replace(
        imu,
        gyro_density=constant_velocity.gyro_density if axes[:3].any() else imu.gyro_density,
        accel_density=constant_velocity.accel_density if axes[3:].any() else imu.accel_density,
    )
