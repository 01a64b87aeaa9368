import numpy as np
import pytest

from share.odometry.initialisation import GravityEstimator
from share.types import ImuBatch

UP = np.array([0.6, 0.0, 0.8])


def batch(accel, gyro=(0.0, 0.0, 0.0), n=10):
    accel = np.broadcast_to(accel, (n, 3))
    return ImuBatch(np.arange(n), np.broadcast_to(gyro, (n, 3)).copy(), accel.copy())


def test_at_rest_up_is_known_from_twenty_samples():
    rest = GravityEstimator()
    assert rest.add(batch(9.8 * UP)) is None
    assert rest.add(batch(9.8 * UP)) == pytest.approx(UP)


def test_the_zero_of_a_cheap_accelerometer_is_no_motion():
    """70 mg, the most that the data sheet of a D435i's BMI055 allows."""
    assert GravityEstimator().add(batch((9.807 + 0.07 * 9.807) * UP, n=20)) == pytest.approx(UP)


@pytest.mark.parametrize(
    "imu",
    [
        batch(9.8 * UP, gyro=(0, 0.5, 0), n=40),  # turning
        batch(8.9 * UP, n=40),  # falling a little
        batch(9.8 * UP + np.where(np.arange(40)[:, None] % 2, 1.0, -1.0), n=40),  # shaking
    ],
)
def test_in_motion_up_is_not_claimed_but_guessed(imu):
    moving = GravityEstimator(max_frames=3)
    assert [moving.add(imu) for _ in range(3)] == [None] * 3
    assert moving.has_timed_out
    assert moving.mean_direction() == pytest.approx(UP, abs=0.05)


def test_rest_after_motion_is_noticed():
    rest = GravityEstimator()
    assert rest.add(batch(9.8 * UP, gyro=(0, 2.0, 0), n=60)) is None
    assert rest.add(batch(9.8 * UP, n=60)) == pytest.approx(UP)


def test_a_silent_imu_has_no_guess():
    silent = GravityEstimator(max_frames=1)
    assert silent.add(ImuBatch.empty()) is None
    assert silent.has_timed_out
    assert silent.mean_direction() is None
