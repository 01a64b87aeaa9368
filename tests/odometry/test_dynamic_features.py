"""While something moves in the view, a new filter waits for features that have proven static."""

from itertools import pairwise

import numpy as np
import pytest

from share.config import Config, InertialConfig
from share.odometry.health import MIN_OK_FEATURES
from share.odometry.landmarks import LandmarkMap
from share.odometry.state import CORE_SIZE, initial_state
from share.runtime.pipeline import read_frames
from share.runtime.source import open_source
from share.sensors.sequencer import SequencerCounters

pytestmark = pytest.mark.long

CONFIG, STILL = InertialConfig(), np.zeros(3)
ENOUGH = MIN_OK_FEATURES // 2


@pytest.fixture(scope="module")
def source(plain_session):
    return open_source(f"{plain_session}/ar1")


@pytest.fixture(scope="module")
def frames(source):
    """Return the frames of a body at rest."""
    return list(read_frames(source, Config(), SequencerCounters()))[:12]


@pytest.fixture
def scene(source, frames):
    state = initial_state(0, np.eye(4), STILL, STILL, STILL, source.rig.T_body_cam0, np.full(CORE_SIZE, 1e-3))
    scene = LandmarkMap(state, source.rig, CONFIG)
    keyframe = scene.add_keyframe(STILL)
    scene.admit_features(frames[0], keyframe, scene.find_corners(frames[0], scene.occupied_px()))
    return scene


def look(scene, last_frame, frame, movers=0):
    """Match a frame in which the first few features move by themselves."""
    matches = scene.match_features(frame, last_frame.image0, 1 / 15)
    matches.is_dynamic[:movers] = True
    scene.record_frame(matches, matches.is_found & ~matches.is_dynamic)


def test_a_static_view_is_static_at_once(frames, scene):
    assert scene.is_static(ENOUGH)
    look(scene, *frames[:2])
    assert scene.is_static(ENOUGH)


def test_with_dynamic_features_enough_must_be_proven_static(frames, scene):
    look(scene, *frames[:2], movers=6)
    assert not scene.is_static(ENOUGH)
    for last_frame, frame in pairwise(frames[1:5]):
        look(scene, last_frame, frame)
        assert not scene.is_static(ENOUGH)
    for last_frame, frame in pairwise(frames[4:8]):
        look(scene, last_frame, frame)
    assert scene.is_static(ENOUGH)
    assert not scene.is_static(len(scene.state.feature_ids) + 1)
