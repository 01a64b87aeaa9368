"""A body at rest: detection by IMU and images, and the zero-velocity update."""

import numpy as np
import pytest
from helpers.imu_world import NOISE, Path, imu_of

from share.config import InertialConfig
from share.geometry import se3
from share.geometry.camera import project
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


FOCAL = 385.0


def answers(frames, hz=15, velocity=(0.0, 0.0, 0.0), rate=0.0, movers=0, first_id=lambda k: 0, still=True):
    """Return what a detector says of each frame of a camera with 40 features 1.5 to 8 m away.

    velocity: m/s, of the camera, x aside and z ahead. rate: rad/s. movers: features that move at 0.3 m/s.
    first_id: of the features in frame k. still: by the IMU.
    """
    rng, detector, out = np.random.default_rng(7), RestDetector(), []
    ray, depth = rng.uniform(-0.6, 0.6, (40, 2)), rng.uniform(1.5, 8.0, 40)
    points = np.column_stack([ray, np.ones(40)]) * depth[:, None]
    for k in range(frames):
        s = state([0.0, 0.0, 0.0], 0.1)
        s.T = se3.from_rt(se3.so3_exp(np.array([0.0, rate * k / hz, 0.0])), np.array(velocity) * k / hz)
        s.stamp_ns, s.feature_ids = k * 10**9 // hz, first_id(k) + np.arange(40)
        s.keyframe_ids, s.keyframe_poses, s.anchor = np.zeros(1, np.int64), np.eye(4)[None], np.zeros(40, int)
        s.ray, s.rho = ray, 1 / depth
        seen = points + (np.arange(40) < movers)[:, None] * [0.0, 0.3 * k / hz, 0.0]
        uv = project(se3.transform(se3.inverse(s.T), seen))[0] + rng.normal(0, 0.1 / FOCAL, (40, 2))
        out.append(detector.is_at_rest(s, uv, np.ones(40, bool), still))
    return out


def test_an_imu_at_constant_velocity_measures_what_one_at_rest_does():
    t, rng = np.arange(0, 1, 1 / NOISE.rate_hz), np.random.default_rng(4)
    predictor, still = ImuPredictor(NOISE, InertialConfig()), Path(1, size=0.0, turn=0.0)
    predictor.buffer.add(imu_of(still, t, rng=rng)[0])
    s = state([0.3, 0.0, 0.0], 0.01)
    s.T, s.stamp_ns = still.poses(0.0), 900_000_000
    assert predictor.predict(s, 950_000_000, gyro_only=False).is_still
    assert s.v[0] == pytest.approx(0.3, abs=0.02)


def test_images_show_rest_after_a_quarter_of_a_second():
    assert answers(8) == [False] * 4 + [True] * 4
    assert answers(12, hz=30) == [False] * 8 + [True] * 4
    assert answers(4, hz=2) == [False] + [True] * 3


def test_the_sway_of_a_standing_person_is_rest():
    """Not the turning counts, 2 px in the time, but the displacement."""
    assert answers(8, velocity=(0.005, 0.0, 0.003), rate=0.02)[-1]


@pytest.mark.parametrize("hz", [5, 15, 30, 60])
@pytest.mark.parametrize("velocity", [(0.1, 0.0, 0.0), (0.0, 0.0, 0.1), (0.0, 0.0, 0.04), (0.03, 0.0, 0.0)])
def test_a_smooth_motion_shows_over_several_frames(hz, velocity):
    """0.1 m/s at 5 m is 7.7 px/s: 0.13 px a frame at 60 Hz."""
    assert not any(answers(2 * hz, hz, velocity))


def test_what_moves_by_itself_does_not_hide_rest():
    assert answers(8, movers=12)[-1]


def test_other_features_say_nothing():
    assert not any(answers(8, first_id=lambda k: 100 * k))


def test_rest_needs_an_imu_that_is_still():
    assert not any(answers(8, still=False))


@pytest.mark.parametrize(
    ("velocity", "sigma", "is_rest"), [(0.0, 0.1, False), (0.08, 0.02, False), (0.01, 0.02, True)]
)
def test_in_the_dark_rest_is_believed_once_the_velocity_is_known(velocity, sigma, is_rest):
    s, none = state([velocity, 0.0, 0.0], sigma), np.zeros((0, 2))
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
