"""A body at rest: detection by IMU and images, and the zero-velocity update."""

import numpy as np
import pytest
from helpers.imu_world import NOISE, Path, imu_of

from share.config import InertialConfig
from share.odometry import filter
from share.odometry.imu_predictor import ImuBuffer, ImuPredictor, fill_clipped
from share.odometry.rest_detection import RestDetector
from share.odometry.state import CORE_SIZE, VELOCITY, initial_state
from share.types import ImuBatch


def state(v, sigma):
    sigmas = np.full(CORE_SIZE, 1e-3)
    sigmas[VELOCITY] = sigma
    return initial_state(0, Path(1).poses(0.0), np.array(v), np.zeros(3), np.zeros(3), np.eye(4), sigmas)


def buffered(imu):
    samples = ImuBuffer()
    samples.add(imu)
    return samples


def test_zero_velocity_update_and_its_gate():
    drifting = state([0.1, -0.05, 0.02], 0.1)
    assert filter.zero_velocity_update(drifting, 0.02)
    assert np.linalg.norm(drifting.v) < 0.006
    assert np.sqrt(drifting.cov[6, 6]) < 0.02
    cruising = state([0.3, 0.0, 0.0], 0.01)
    before = cruising.cov.copy()
    assert not filter.zero_velocity_update(cruising, 0.02)
    assert (cruising.v == [0.3, 0.0, 0.0]).all()
    assert (cruising.cov == before).all()


def test_noise_alone_is_rest_and_motion_is_not():
    t, rng = np.arange(0, 1, 1 / NOISE.rate_hz), np.random.default_rng(4)
    still = Path(1, size=0.0, turn=0.0)
    assert buffered(imu_of(still, t, 0.01, 0.2, rng)[0]).is_still(10**9)
    assert not buffered(imu_of(Path(1, size=1.0, turn=0.0), t, 0.01, 0.2, rng)[0]).is_still(10**9)
    assert not buffered(imu_of(Path(1, size=0.0, turn=0.1), t, 0.01, 0.2, rng)[0]).is_still(10**9)


def views(frames, hz=15, speed_px_s=0.0, count=40, noise_px=0.05, movers=0, first_id=lambda k: 0):
    """Return what a detector says of each of some frames that move by `speed_px_s`, `movers` of their
    features at 100 px/s. first_id: of the features in frame k."""
    rng, detector = np.random.default_rng(7), RestDetector()
    where, said = rng.uniform(0, 600, (count, 2)), []
    for k in range(frames):
        s = state([0.0, 0.0, 0.0], 0.1)
        s.stamp_ns, s.feature_ids = k * 10**9 // hz, first_id(k) + np.arange(count)
        px = where + [speed_px_s * k / hz, 0.0] + rng.normal(0, noise_px, where.shape)
        px[:movers, 1] += 100.0 * k / hz
        said.append(detector.is_at_rest(s, px.astype(np.float32), np.ones(count, bool), imu_is_still=True))
    return said


def test_an_imu_at_constant_velocity_measures_what_one_at_rest_does():
    t, rng = np.arange(0, 1, 1 / NOISE.rate_hz), np.random.default_rng(4)
    predictor, still = ImuPredictor(NOISE, InertialConfig()), Path(1, size=0.0, turn=0.0)
    predictor.buffer.add(imu_of(still, t, rng=rng)[0])
    s = state([0.3, 0.0, 0.0], 0.01)
    s.T, s.stamp_ns = still.poses(0.0), 900_000_000
    assert predictor.predict(s, 950_000_000, gyro_only=False).is_still
    assert s.v[0] == pytest.approx(0.3, abs=0.02)


def test_images_that_stay_show_rest_after_a_quarter_of_a_second():
    assert views(8) == [False] * 4 + [True] * 4
    assert views(12, hz=30) == [False] * 8 + [True] * 4
    assert views(4, hz=2) == [False] + [True] * 3


@pytest.mark.parametrize(("hz", "speed_px_s"), [(15, 7.5), (30, 7.5), (30, 2.0), (60, 7.5)])
def test_a_slow_motion_shows_over_several_frames(hz, speed_px_s):
    """0.1 m/s at 5 m is 7.5 px/s: 0.25 px a frame at 30 Hz."""
    assert not any(views(2 * hz, hz, speed_px_s))


def test_what_moves_by_itself_does_not_hide_rest():
    assert views(8, movers=15)[-1]
    assert not views(8, movers=25)[-1]


def test_other_features_say_nothing():
    assert not any(views(8, first_id=lambda k: 100 * k))


def test_rest_needs_an_imu_that_is_still():
    detector, px, is_static = RestDetector(), np.zeros((40, 2), np.float32), np.ones(40, bool)
    for k in range(8):
        s = state([0.0, 0.0, 0.0], 0.01)
        s.stamp_ns, s.feature_ids = k * 10**8, np.arange(40)
        assert not detector.is_at_rest(s, px, is_static, imu_is_still=False)


@pytest.mark.parametrize(
    ("velocity", "sigma", "is_rest"), [(0.0, 0.1, False), (0.08, 0.02, False), (0.01, 0.02, True)]
)
def test_in_the_dark_rest_is_believed_once_the_velocity_is_known(velocity, sigma, is_rest):
    s, none = state([velocity, 0.0, 0.0], sigma), np.zeros((0, 2), np.float32)
    assert RestDetector().is_at_rest(s, none, np.zeros(0, bool), imu_is_still=True) == is_rest


def test_no_recent_samples_is_not_rest():
    t = np.arange(0, 1, 1 / NOISE.rate_hz)
    imu = imu_of(Path(1, size=0.0, turn=0.0), t, rng=np.random.default_rng(5))[0]
    assert not buffered(imu).is_still(2 * 10**9)
    assert not ImuBuffer().is_still(0)


def test_a_clipped_axis_is_detected():
    t, rng = np.arange(0, 1, 1 / NOISE.rate_hz), np.random.default_rng(6)
    imu = imu_of(Path(2, turn=3.0), t, rng=rng)[0]
    assert not buffered(imu).is_clipped(imu).any()
    most = np.abs(imu.gyro).max() / 2
    cut = ImuBatch(imu.stamps_ns, imu.gyro.clip(-most, most), imu.accel)
    assert buffered(cut).is_clipped(cut)[:3].any()
    assert not buffered(cut).is_clipped(cut)[3:].any()


def test_a_clipped_axis_is_extrapolated():
    imu = ImuBatch(np.arange(2), np.array([[1.0, -1.0, 1.0], [1.0, 0.2, 1.0]]), np.zeros((2, 3)))
    out = fill_clipped(imu, np.array([True, True, False]), np.array([1.5, -2.0, 9.0]))
    assert out.gyro.tolist() == [[1.5, -2.0, 1.0], [1.5, 0.2, 1.0]]
