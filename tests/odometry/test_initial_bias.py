"""A bias known from an earlier run: the filter begins with it, and returns its own estimate."""

import numpy as np
import pytest
from helpers.imu_world import GRAVITY, NOISE, rig

from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import ImuBias
from share.odometry.inertial_tracker import InertialTracker
from share.odometry.initialisation import estimated_bias, state_from_imu, tilt_sigma, unknown_bias
from share.odometry.state import ACCEL_BIAS, CORE_SIZE, GYRO_BIAS, initial_state
from share.types import Frame, ImuBatch

CONFIG = InertialConfig()
GYRO, ACCEL = np.array([0.006, -0.004, 0.005]), np.array([0.25, -0.2, 0.15])
X, Z = np.eye(3)[[0, 2]]
KNOWN = ImuBias(GYRO, ACCEL, 0.003, 0.1)
LEVEL = se3.exp(np.array([0.1, -0.2, 0.3, 0, 0, 0]))[:3, :3]  # R_odom_body


def at_rest(gyro=GYRO, accel=ACCEL, shake=0.0):
    """Half a second of an IMU that lies still, or is shaken, m/s^2."""
    rng, n = np.random.default_rng(3), 100
    force = LEVEL.T @ np.array([0.0, 0.0, GRAVITY]) + accel + rng.normal(0, 0.03 + shake, (n, 3))
    return ImuBatch(np.arange(1, n + 1) * 5_000_000, gyro + rng.normal(0, 0.003, (n, 3)), force)


def begun(imu, bias):
    state = state_from_imu(int(imu.stamps_ns[-1]), imu, rig(), CONFIG, bias)
    assert state is not None
    up = float(np.degrees(np.arccos(np.clip(state.T[2, :3] @ LEVEL[2], -1, 1))))
    return state, up


def test_a_known_bias_gives_the_up_direction():
    state, off_deg = begun(at_rest(), unknown_bias(CONFIG))
    assert 2.3 < np.degrees(tilt_sigma(state)) < 2.7
    assert off_deg > 1.0
    state, off_deg = begun(at_rest(), KNOWN)
    assert np.degrees(tilt_sigma(state)) < 0.9
    assert off_deg < 0.1
    np.testing.assert_allclose(state.ba, ACCEL, atol=0.02)
    np.testing.assert_allclose(state.bg, GYRO, atol=0.002)


def test_the_tilt_sigma_follows_from_the_bias_sigma():
    off = ImuBias(GYRO, ACCEL + np.array([0.1, -0.1, 0.1]), 0.003, 0.1)
    state, off_deg = begun(at_rest(), off)
    assert 0.4 < off_deg < 2 * np.degrees(tilt_sigma(state))


@pytest.mark.parametrize(
    ("gyro", "accel"), [(GYRO + 0.03 * X, ACCEL), (GYRO, ACCEL + 0.5 * Z)], ids=["turn", "force"]
)
def test_samples_at_rest_override_a_contradicting_bias(gyro, accel):
    contradicted, _ = begun(at_rest(gyro, accel), KNOWN)
    unknown, _ = begun(at_rest(gyro, accel), unknown_bias(CONFIG))
    assert contradicted.cov.tobytes() == unknown.cov.tobytes()
    assert contradicted.ba.tobytes() == unknown.ba.tobytes()
    agreeing, _ = begun(at_rest(), KNOWN)
    assert tilt_sigma(agreeing) < 0.5 * tilt_sigma(unknown)


def test_a_mean_force_in_motion_does_not_contradict_the_bias():
    moving, _ = begun(at_rest(accel=ACCEL + 0.5 * Z, shake=1.0), KNOWN)
    assert np.sqrt(np.diag(moving.cov)[ACCEL_BIAS]).max() <= 0.1


def state(gyro_sigma, accel_sigma, ba=ACCEL):
    sigma = np.full(CORE_SIZE, 1e-3)
    sigma[GYRO_BIAS], sigma[ACCEL_BIAS] = gyro_sigma, accel_sigma
    return initial_state(0, np.eye(4), np.zeros(3), GYRO, ba, np.eye(4), sigma)


def test_the_estimated_bias_is_that_of_the_filter():
    learnt = estimated_bias(state(0.0002, 0.01), CONFIG)
    assert learnt is not None
    np.testing.assert_array_equal(learnt.gyro, GYRO)
    np.testing.assert_array_equal(learnt.accel, ACCEL)
    assert (learnt.gyro_sigma, learnt.accel_sigma) == pytest.approx((0.0002, 0.01))


@pytest.mark.parametrize(
    "s",
    [
        state(0.0002, 0.3),  # as it begins
        state(0.0002, 0.1),  # as it begins with one that is known
        state(0.02, 0.01),
        state(0.0002, 0.01, np.array([0.0, 3.5, 0.0])),
        state(0.0002, 0.01, np.array([0.0, np.nan, 0.0])),
    ],
)
def test_an_uncertain_or_implausible_bias_is_not_returned(s):
    assert estimated_bias(s, CONFIG) is None


def test_imu_noise_of_the_test_rig():
    assert NOISE.accel_density / np.sqrt(0.005) == pytest.approx(0.03, rel=0.1)


@pytest.mark.parametrize("late_s", [0.0, 0.2])
def test_a_state_does_not_begin_with_samples_of_a_while_ago(late_s):
    imu = at_rest()
    image_ns = int(imu.stamps_ns[-1]) + round(late_s * 1e9)
    state = state_from_imu(image_ns, imu, rig(), CONFIG, unknown_bias(CONFIG))
    assert (state is None) == (late_s > 0.1)


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.filterwarnings("error")
def test_a_state_does_not_begin_without_a_force(noise):
    """In free fall, or of an accelerometer that is dead, nothing shows which way is up."""
    imu = at_rest()
    weightless = ImuBatch(imu.stamps_ns, imu.gyro, np.random.default_rng(1).normal(0, noise, (len(imu), 3)))
    assert state_from_imu(int(imu.stamps_ns[-1]), weightless, rig(), CONFIG, unknown_bias(CONFIG)) is None


@pytest.mark.parametrize(
    ("imu", "bias", "dropped"),
    [
        (at_rest(), KNOWN, False),
        (at_rest(accel=ACCEL + 0.5 * Z), KNOWN, True),
        (at_rest(accel=ACCEL + 0.5 * Z, shake=1.0), KNOWN, False),
        (at_rest(accel=ACCEL + 3.0 * Z), None, False),
        (ImuBatch.empty(), KNOWN, False),
    ],
    ids=["agrees", "contradicts", "in motion", "none", "silent"],
)
def test_the_tracker_tells_that_it_drops_a_contradicted_bias(imu, bias, dropped):
    tracker, dark = InertialTracker(rig(), CONFIG, bias), np.zeros((480, 640), np.uint8)
    tracker.track(Frame(500_000_000, 0, dark, dark, imu=imu))
    assert tracker.has_dropped_bias == dropped
