"""Real stereo images that are 0.05 to 7 s apart, with the whole IMU between them."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from share.config import Config
from share.geometry import se3
from share.geometry.interpolation import interpolate
from share.odometry.track_result import TrackResult
from share.runtime.pipeline import make_tracker, read_frames
from share.runtime.source import open_source
from share.sensors.sequencer import SequencerCounters
from share.types import F64, TrackState

Tracked = list[tuple[float, TrackResult, F64]]  # s, result, true pose of the motion capture's body


@pytest.fixture(scope="module")
def tracked(shared_data: Path) -> Tracked:
    source, config = open_source(str(shared_data / "real" / "euroc_v1_01_keyframes")), Config()
    truth, tracker, out = source.truth(), make_tracker(source.rig, config), []
    assert truth is not None
    for frame in read_frames(source, config, SequencerCounters()):
        result = tracker.track(frame)
        _, T = interpolate(*truth, np.array([frame.stamp_ns]))
        out.append((frame.stamp_ns * 1e-9, result, T[0]))
    return out


def test_pairs_up_to_a_second_apart_are_right(tracked):
    """To 2 % of the motion and 1 cm, without the motion capture moved to the IMU."""
    errors, allowed = [], []
    for (t0, a, true_a), (t1, b, true_b) in pairwise(tracked):
        if t1 - t0 > 1 or a.T_odom_body is None or b.T_odom_body is None or b.new_segment:
            continue
        true = se3.inverse(true_a) @ true_b
        off = se3.inverse(true) @ se3.inverse(a.T_odom_body) @ b.T_odom_body
        errors.append(np.linalg.norm(off[:3, 3]))
        allowed.append(0.02 * np.linalg.norm(true[:3, 3]) + 0.01)
    assert len(errors) >= 4
    assert (np.array(errors) < allowed).all()


def test_no_segment_begins_without_features(tracked):
    """The IMU alone seems to know tilt and velocity where three wrong features were believed."""
    begun = [result for _, result, _ in tracked if result.new_segment]
    assert begun
    assert all(result.state in (TrackState.OK, TrackState.WEAK) for result in begun)
