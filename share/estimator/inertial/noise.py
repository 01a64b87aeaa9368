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
    sums = np.zeros((len(samples) + 1, 6))
    np.cumsum(np.concatenate([samples.gyro, samples.accel], axis=1), axis=0, out=sums[1:])
    shown = []  # squared densities
    for block in {max(1, round(block_s / step_s)) for block_s in _BLOCKS_S}:
        fourth = _fourth_differences(sums, block)  # of the sums: third ones of the means, times block
        if (count := len(fourth)) > block:
            shown.append(np.einsum("na,na->a", fourth, fourth) * (step_s / (_TIMES * count * block)))
    if not shown:
        return imu
    least = np.sqrt(np.min(shown, axis=0))
    return replace(
        imu,
        gyro_density=max(imu.gyro_density, float(least[:3].max())),
        accel_density=max(imu.accel_density, float(least[3:].max())),
    )


def _fourth_differences(x: F64, by: int) -> F64:
    """Of (N, 6), between rows `by` apart: (N - 4 by, 6)."""
    out = x
    for _ in range(4):
        out = out[by:] - out[:-by]
    return out


def without(imu: ImuNoise, coasting: ImuNoise, axes: NDArray[np.bool_]) -> ImuNoise:
    """Of an IMU of whose axes (6,), gyro then accelerometer, some say nothing."""
    return replace(
        imu,
        gyro_density=coasting.gyro_density if axes[:3].any() else imu.gyro_density,
        accel_density=coasting.accel_density if axes[3:].any() else imu.accel_density,
    )
