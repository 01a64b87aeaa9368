"""How loud the IMU is taken to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import ImuNoise
from share.types import F64, ImuBatch

_BLOCKS_S = 0.005, 0.01, 0.015, 0.02  # of samples whose means are compared
_TIMES = 20.0  # by which third differences have more variance than what is white


def louder(imu: ImuNoise, times: float) -> ImuNoise:
    """Densities and walks so many times as large."""
    return ImuNoise(
        imu.gyro_density * times,
        imu.accel_density * times,
        imu.gyro_walk * times,
        imu.accel_walk * times,
        imu.rate_hz,
    )


def shaken(imu: ImuNoise, samples: ImuBatch) -> ImuNoise:
    """Densities no smaller than those that the samples themselves show.

    What shakes a body faster than its IMU is sampled is noise to who integrates the samples. The body's own
    motion is smooth beside it: third differences of means over blocks of b seconds hold 20 times the variance
    of white noise in them, and of a motion of frequency f only (2 sin(pi f b))^6. White noise shows the same
    density by any b; of a vibration longer blocks show less, as an integral holds less of it; of a motion
    they show more. So the least counts.
    """
    if len(samples) < 2:
        return imu
    step_s = (samples.stamps_ns[-1] - samples.stamps_ns[0]) * 1e-9 / (len(samples) - 1)
    values = np.hstack([samples.gyro, samples.accel])
    sums = np.concatenate([np.zeros((1, 6)), np.cumsum(values, axis=0)])
    shown = np.full(6, np.inf)
    for block in (max(1, round(block_s / step_s)) for block_s in _BLOCKS_S):
        third = _third_differences((sums[block:] - sums[:-block]) / block, block)
        if len(third) > block:
            shown = np.minimum(shown, np.sqrt((third**2).mean(axis=0) / _TIMES * block * step_s))
    if np.isinf(shown).any():
        return imu
    return replace(
        imu,
        gyro_density=max(imu.gyro_density, float(shown[:3].max())),
        accel_density=max(imu.accel_density, float(shown[3:].max())),
    )


def _third_differences(x: F64, by: int) -> F64:
    """Of (N, 6), between rows `by` apart: (N - 3 by, 6)."""
    out = x
    for _ in range(3):
        out = out[by:] - out[:-by]
    return out


def without(imu: ImuNoise, coasting: ImuNoise, axes: NDArray[np.bool_]) -> ImuNoise:
    """Of an IMU of whose axes (6,), gyro then accelerometer, some say nothing."""
    return replace(
        imu,
        gyro_density=coasting.gyro_density if axes[:3].any() else imu.gyro_density,
        accel_density=coasting.accel_density if axes[3:].any() else imu.accel_density,
    )
