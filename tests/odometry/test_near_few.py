"""A near few do not outweigh the room while a filter is young: they may be somebody who sways."""

import numpy as np
from helpers.imu_world import rig

from share.config import InertialConfig
from share.odometry import feature_appearance, filter, state
from share.odometry.feature_matching import FeatureMatches, predict
from share.odometry.landmarks import LandmarkMap
from share.odometry.state import CORE_SIZE, GYRO_BIAS, POSE, VELOCITY

RIG, STILL = rig(), np.zeros(3)
ROOM, NEAR = 66, 7


def young_filter(bias_sigma):
    """A body at rest before a room 3 to 7 m away, and 7 features 0.7 m away."""
    rng, sigma = np.random.default_rng(3), np.full(CORE_SIZE, 1e-4)
    sigma[VELOCITY], sigma[GYRO_BIAS] = 0.1, bias_sigma
    s = state.initial_state(0, np.eye(4), STILL, STILL, STILL, RIG.T_body_cam0, sigma)
    landmarks = LandmarkMap(s, RIG, InertialConfig())
    landmarks.add_keyframe(STILL)
    s.cov[POSE, POSE] += np.diag(np.repeat([3e-4, 1e-2], 3) ** 2)  # what a moment adds
    px = rng.uniform((20, 20), (620, 460), (ROOM + NEAR, 2))
    px[ROOM:] = rng.uniform((280, 100), (360, 300), (NEAR, 2))
    rho = np.r_[1 / rng.uniform(3, 7, ROOM), np.full(NEAR, 1 / 0.7)]
    ray = RIG.cam0.normalise(px)
    count = len(px)
    state.add_features(s, np.arange(count), np.zeros(count, int), ray, rho, np.full(count, 0.01))
    image = np.zeros((480, 640), np.uint8)
    landmarks.appearance = feature_appearance.extract_appearance(
        image, RIG.cam0, px.astype(np.float32), ray, rho
    )
    return landmarks


def seen(landmarks, shift_m):
    """Matches in a frame of the body at rest, while what is near has moved sideways by shift_m."""
    s, n = landmarks.state, len(landmarks.state.feature_ids)
    uv = predict(s, np.arange(n)).uv
    at = uv.copy()
    at[ROOM:, 0] += shift_m * s.rho[ROOM:]
    px = RIG.cam0.distort(at).astype(np.float32)
    yes, none = np.ones(n, bool), np.zeros((n, 2))
    return FeatureMatches(
        px, at, yes, ~yes, RIG.cam0.distort(uv), uv, np.zeros((n, 2, 2)), none, np.zeros((n, 1), np.float32)
    )


def moved_m(bias_sigma):
    """How far the body seems to move where what is near moves by 2 mm."""
    landmarks = young_filter(bias_sigma)
    rows = landmarks.frame_measurements(seen(landmarks, 0.002), STILL)
    filter.update(landmarks.state, rows, *filter.innovation_covariance(landmarks.state, rows))
    return np.linalg.norm(landmarks.state.T[:3, 3])


def test_a_near_few_do_not_outweigh_the_room_while_the_bias_is_unknown():
    young, older = moved_m(5e-3), moved_m(1e-3)
    print(young, older)
    assert young < 0.5e-3
    assert older > 1e-3


def test_a_wall_that_is_near_is_the_room():
    landmarks = young_filter(5e-3)
    landmarks.state.rho[: ROOM // 2] = 1 / 0.7
    sigma = landmarks.frame_measurements(seen(landmarks, 0.0), STILL).sigma
    assert sigma.min() == sigma.max()
