"""How well the bias that a run has learnt of its IMU is known when the next run begins."""

from __future__ import annotations

import numpy as np

from share.config import InertialConfig
from share.geometry.camera import ImuBias, ImuNoise

# From one power-on to the next. What a MEMS sensor adds goes with its temperature: 1 mg/K and 0.015 deg/s/K
# (Bosch BMI055, data sheet), and a camera that is switched on warms up by some 10 K within half an hour; a
# D435i's accelerometer went by 0.14 m/s^2 meanwhile (realsense-ros, issue 1809).
POWER_ON_GYRO, POWER_ON_ACCEL = 0.003, 0.1  # rad/s, m/s^2


def aged(bias: ImuBias, noise: ImuNoise, age_s: float, config: InertialConfig) -> ImuBias | None:
    """`bias` as of a run that ended `age_s` ago: since then it has walked as the IMU's noise says, and the
    IMU may have been switched off. None where that is no better than what is known of any IMU."""
    walked_s = max(age_s, 0.0) * config.imu_noise**2
    gyro = np.sqrt(bias.gyro_sigma**2 + POWER_ON_GYRO**2 + noise.gyro_walk**2 * walked_s)
    accel = np.sqrt(bias.accel_sigma**2 + POWER_ON_ACCEL**2 + noise.accel_walk**2 * walked_s)
    if not (gyro < config.gyro_bias and accel < config.accel_bias):
        return None
    return ImuBias(bias.gyro, bias.accel, float(gyro), float(accel))
