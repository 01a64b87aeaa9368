"""A body at rest: detection by the IMU, and the zero-velocity update."""

import numpy as np
from helpers.imu_world import NOISE, Path, imu_of

from share.config import InertialConfig
from share.odometry import filter
from share.odometry.imu_predictor import ImuBuffer, ImuPredictor, fill_clipped
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


def test_rest_is_believed_once_the_velocity_is_known():
    """An IMU that moves smoothly measures the same as one at rest."""
    t, rng = np.arange(0, 1, 1 / NOISE.rate_hz), np.random.default_rng(4)
    predictor, still = ImuPredictor(NOISE, InertialConfig()), Path(1, size=0.0, turn=0.0)
    predictor.buffer.add(imu_of(still, t, rng=rng)[0])
    for velocity, sigma, is_updated in ((0.0, 0.1, False), (0.08, 0.02, False), (0.01, 0.02, True)):
        s = state([velocity, 0.0, 0.0], sigma)
        s.T, s.stamp_ns = still.poses(0.0), 900_000_000
        predictor.predict(s, 950_000_000, gyro_only=False)
        assert (np.sqrt(s.cov[6, 6]) < 0.8 * sigma) == is_updated


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
