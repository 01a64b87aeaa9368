"""Static and dynamic features: a part of the view moves by itself, with and without the IMU's prior."""

import numpy as np
import pytest
from helpers.imu_world import CAMERA, rig

from share.odometry import feature_matching, filter, visual_update
from share.odometry import state as filter_state
from share.odometry.state import CORE_SIZE, VELOCITY, initial_state

RIG, SIZE = rig(), (CAMERA.width, CAMERA.height)
SIGMA = 0.5 / CAMERA.focal
N = 100


@pytest.fixture
def state():
    """A body that has gone on a little since its only keyframe, and knows where it is to a few mm."""
    rng, sigma = np.random.default_rng(1), np.full(CORE_SIZE, 1e-4)
    sigma[VELOCITY] = 0.01
    s = initial_state(0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), RIG.T_body_cam0, sigma)
    host = filter_state.add_keyframe(s, 0, np.zeros(3))
    px = np.stack(np.meshgrid(np.linspace(40, SIZE[0] - 40, 10), np.linspace(40, SIZE[1] - 40, 10)), -1)
    ray = RIG.cam0.normalise(px.reshape(-1, 2))
    filter_state.add_features(
        s, np.arange(N), np.full(N, host), ray, rng.uniform(0.2, 1.0, N), np.full(N, 1e-3)
    )
    s.cov[:6, :6] += np.diag(np.repeat([1e-3, 2e-3], 3) ** 2)
    return s


def judged(state, shift_px, proven=None, noise=0.3):
    """Which of the features are taken for the room seen shift_px (N, 2) from where they should be."""
    seen = feature_matching.predict(state, np.arange(N))
    rng = np.random.default_rng(2)
    uv = seen.uv + (shift_px + noise * rng.normal(size=(N, 2))) / CAMERA.focal
    rows = filter.feature_measurements(
        state, np.arange(N), seen, uv, np.full(N, SIGMA), np.zeros(N), np.zeros(3)
    )
    px = RIG.cam0.distort(uv).astype(np.float32)
    return visual_update.static_inliers(
        state, rows, px, np.ones(N, bool) if proven is None else proven, RIG.cam0
    )


def mistaken(room, mover):
    """Features on the wrong side, (N,) both."""
    return (room == mover).sum()


def part(state, left_of):
    """Features in the left part of the image."""
    return RIG.cam0.distort(feature_matching.predict(state, np.arange(N)).uv)[:, 0] < left_of * SIZE[0]


def test_noise_leaves_all_static(state):
    assert judged(state, np.zeros(2)).all()


def test_a_few_outliers_are_left_to_the_gate(state):
    shift = np.zeros((N, 2))
    shift[:10] = 20.0
    assert judged(state, shift).all()


@pytest.mark.parametrize("share", [0.3, 0.45])
def test_dynamic_features_are_found(state, share):
    mover = part(state, share)
    shift = np.where(mover[:, None], [4.0, 2.0], [0.0, 0.0])
    assert mistaken(judged(state, shift), mover) <= 2


def test_dynamic_features_that_fill_most_of_the_view_are_found(state):
    mover = part(state, 0.6)
    shift = np.where(mover[:, None], [12.0, 0.0], [0.0, 0.0])
    assert mistaken(judged(state, shift), mover) <= 2


def test_unproven_features_do_not_score(state):
    mover = part(state, 0.6)
    shift = np.where(mover[:, None], [3.0, 0.0], [0.0, 0.0])
    assert mistaken(judged(state, shift, proven=~mover), mover) <= 2


def test_a_motion_that_the_imu_missed_leaves_all_static(state):
    """All of the room shifts alike, by what the filter holds for possible."""
    seen = feature_matching.predict(state, np.arange(N))
    shift = seen.H_pose[:, :, 3:] @ np.array([2e-3, -2e-3, 1e-3]) * CAMERA.focal
    assert np.abs(shift).max() > 1.0
    assert judged(state, shift).all()


def test_too_few_features_are_static(state):
    few = np.arange(5)
    seen = feature_matching.predict(state, few)
    rows = filter.feature_measurements(
        state, few, seen, seen.uv + 1.0, np.full(5, SIGMA), np.zeros(5), np.zeros(3)
    )
    assert visual_update.static_inliers(
        state, rows, np.zeros((5, 2), np.float32), np.ones(5, bool), RIG.cam0
    ).all()


@pytest.mark.parametrize(("share", "as_expected"), [(0.05, True), (0.3, False), (1.0, False)])
def test_residuals_that_the_imu_explains(share, as_expected):
    """Else a consensus decides; also if all of the image moves."""
    off_px = np.random.default_rng(4).normal(0, 0.3, (N, 2))
    off_px[: round(share * N)] += 3.0
    assert visual_update.matches_imu(off_px, 0.15) == as_expected
