"""Which keyframes are dropped where there are too many."""

import dataclasses

import numpy as np
import pytest

from share.config import Config, InertialConfig
from share.odometry.landmarks import LandmarkMap
from share.odometry.state import CORE_SIZE, initial_state
from share.runtime.pipeline import read_frames
from share.runtime.source import open_source
from share.sensors.sequencer import SequencerCounters

pytestmark = pytest.mark.long

STILL = np.zeros(3)


@pytest.mark.parametrize("held", [(), (0,), (0, 1)])
def test_published_keyframes_stay(plain_session, held):
    source = open_source(f"{plain_session}/ar1")
    frame = next(iter(read_frames(source, Config(), SequencerCounters())))
    state = initial_state(0, np.eye(4), STILL, STILL, STILL, source.rig.T_body_cam0, np.full(CORE_SIZE, 1e-3))
    scene = LandmarkMap(state, source.rig, dataclasses.replace(InertialConfig(), max_keyframes=2))
    for _ in range(6):  # all at one place
        keyframe = scene.add_keyframe(STILL)
        scene.admit_features(frame, keyframe, scene.find_corners(frame, scene.occupied_px())[:10])
        scene.drop_keyframes(held)
    assert set(held) | {4, 5} <= set(state.keyframe_ids.tolist())
    assert len(state.keyframe_ids) == max(2, len(held) + 2)
