"""How loud the IMU is taken to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import ImuNoise


def louder(imu: ImuNoise, times: float) -> ImuNoise:
    """Densities and walks so many times as large."""
    return ImuNoise(
        imu.gyro_density * times,
        imu.accel_density * times,
        imu.gyro_walk * times,
        imu.accel_walk * times,
        imu.rate_hz,
    )


def without(imu: ImuNoise, coasting: ImuNoise, axes: NDArray[np.bool_]) -> ImuNoise:
    """Of an IMU of whose axes (6,), gyro then accelerometer, some say nothing."""
    return replace(
        imu,
        gyro_density=coasting.gyro_density if axes[:3].any() else imu.gyro_density,
        accel_density=coasting.accel_density if axes[3:].any() else imu.accel_density,
    )
