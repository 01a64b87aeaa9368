"""Which keyframes of a scene go where there are too many."""

import dataclasses

import numpy as np
import pytest

from share.config import Config, InertialConfig
from share.odometry.landmarks import Scene
from share.odometry.state import CORE, begin
from share.runtime.pipeline import frames_of
from share.runtime.source import open_source
from share.sensors.sequencer import SequencerCounters

STILL = np.zeros(3)


@pytest.mark.parametrize("held", [(), (0,), (0, 1)])
def test_those_that_others_are_told_of_stay(plain_session, held):
    source = open_source(f"{plain_session}/ar1")
    frame = next(iter(frames_of(source, Config(), SequencerCounters())))
    state = begin(0, np.eye(4), STILL, STILL, STILL, source.rig.T_body_cam0, np.full(CORE, 1e-3))
    scene = Scene(state, source.rig, dataclasses.replace(InertialConfig(), max_keyframes=2))
    for _ in range(6):  # all at one place
        keyframe = scene.add_keyframe(STILL)
        scene.admit(frame, keyframe, scene.corners(frame, scene.taken())[:10])
        scene.forget(held)
    assert set(held) | {4, 5} <= set(state.keyframes.tolist())
    assert len(state.keyframes) == max(2, len(held) + 2)
