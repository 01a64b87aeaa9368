"""How loud the IMU is taken to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import ImuNoise
from share.types import ImuBatch

_ORDER, _TIMES = 3, 20.0  # of differences; by which they have more variance than what is white
_FEWEST = 8  # samples


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

    Vibration that is too fast for the sampling is, to who integrates the samples, noise that is white from
    one to the next. A body's motion is smooth beside it: third differences of samples s apart hold 20 times
    the variance of such noise, and of a motion of frequency f only (2 sin(pi f s))^6, about as much as the
    trapezoidal rule leaves of it.
    """
    if len(samples) < _FEWEST:
        return imu
    step_s = (samples.stamps_ns[-1] - samples.stamps_ns[0]) * 1e-9 / (len(samples) - 1)
    both = np.diff(np.hstack([samples.gyro, samples.accel]), _ORDER, axis=0)
    density = np.sqrt((both**2).mean(axis=0) / _TIMES * step_s)
    return replace(
        imu,
        gyro_density=max(imu.gyro_density, float(density[:3].max())),
        accel_density=max(imu.accel_density, float(density[3:].max())),
    )


def without(imu: ImuNoise, coasting: ImuNoise, axes: NDArray[np.bool_]) -> ImuNoise:
    """Of an IMU of whose axes (6,), gyro then accelerometer, some say nothing."""
    return replace(
        imu,
        gyro_density=coasting.gyro_density if axes[:3].any() else imu.gyro_density,
        accel_density=coasting.accel_density if axes[3:].any() else imu.accel_density,
    )
