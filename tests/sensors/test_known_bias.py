"""What is still known of an IMU's bias some time after the run that learnt it."""

from __future__ import annotations

import numpy as np
import pytest

from share.config import InertialConfig
from share.geometry.camera import ImuBias, ImuNoise
from share.sensors.imu_memory import POWER_ON_ACCEL, POWER_ON_GYRO, propagate_bias

CONFIG = InertialConfig()
BMI055 = ImuNoise(2.44e-4, 1.47e-3, 1.0e-5, 1.5e-4, 400.0)
LEARNT = ImuBias(np.array([0.004, -0.005, 0.006]), np.array([0.1, -0.2, 0.25]), 0.0002, 0.004)
DAY_S = 86_400.0


def test_the_bias_stays_and_its_sigma_is_that_of_another_power_on() -> None:
    now = propagate_bias(LEARNT, BMI055, 60.0, CONFIG)
    assert now is not None
    np.testing.assert_array_equal(now.gyro, LEARNT.gyro)
    np.testing.assert_array_equal(now.accel, LEARNT.accel)
    assert now.gyro_sigma == pytest.approx(POWER_ON_GYRO, rel=0.02)
    assert now.accel_sigma == pytest.approx(POWER_ON_ACCEL, rel=0.02)


def test_it_walks_as_the_noise_says_that_the_filter_goes_by() -> None:
    now = propagate_bias(LEARNT, BMI055, DAY_S, CONFIG)
    assert now is not None
    walked = CONFIG.imu_noise * BMI055.accel_walk * np.sqrt(DAY_S)
    assert walked > 0.08
    assert now.accel_sigma**2 == pytest.approx(LEARNT.accel_sigma**2 + POWER_ON_ACCEL**2 + walked**2)
    turned = CONFIG.imu_noise * BMI055.gyro_walk * np.sqrt(DAY_S)
    assert now.gyro_sigma**2 == pytest.approx(LEARNT.gyro_sigma**2 + POWER_ON_GYRO**2 + turned**2)


@pytest.mark.parametrize("days", [60.0, 1e5, np.inf])
def test_after_long_nothing_is_known_of_it(days: float) -> None:
    assert propagate_bias(LEARNT, BMI055, DAY_S, CONFIG) is not None
    assert propagate_bias(LEARNT, BMI055, days * DAY_S, CONFIG) is None


def test_who_learnt_less_than_anybody_knows_tells_nothing() -> None:
    vague = ImuBias(LEARNT.gyro, LEARNT.accel, CONFIG.gyro_bias, 0.01)
    assert propagate_bias(vague, BMI055, 0.0, CONFIG) is None
