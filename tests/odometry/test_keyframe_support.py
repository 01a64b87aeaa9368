"""What both trackers say that the pose of a keyframe rests on."""

from __future__ import annotations

import numpy as np
import pytest

from share.config import Config, InertialConfig, TrackerConfig
from share.odometry.inertial_tracker import InertialTracker
from share.odometry.track_result import TrackResult
from share.odometry.visual_tracker import VisualTracker
from share.runtime.pipeline import read_frames
from share.runtime.source import open_source
from share.sensors.sequencer import SequencerCounters
from share.types import FeatureStatistics, Frame
from share.vision.depth import from_stereo

Walk = tuple[list[Frame], list[tuple[Frame, FeatureStatistics, TrackResult]]]


@pytest.fixture(scope="module", params=["inertial", "visual"])
def walk(request, plain_session):
    """Rig, and of each keyframe: its own frame, its footing and what the tracker said of it."""
    source = open_source(f"{plain_session}/ar1")
    rig = source.rig
    tracker = (
        InertialTracker(rig, InertialConfig(), TrackerConfig())
        if request.param == "inertial"
        else VisualTracker(rig, TrackerConfig())
    )
    told, tracked = [], []
    for frame in read_frames(source, Config(), SequencerCounters()):
        result = tracker.track(frame)
        tracked.append((frame, result))
        if result.keyframe_ready:
            before = tracker.feature_statistics()
            own, its_result = tracked[-1 - tracker.make_keyframe(frame).frames_ago]
            told.append((own, before, its_result))
            again = tracker.feature_statistics()  # what joined since is not what the pose rests on
            if request.param == "inertial":
                assert again.px.tobytes() == before.px.tobytes()
    return rig, told


def test_what_a_pose_rests_on_is_counted_and_in_the_image(walk):
    rig, told = walk
    assert len(told) >= 2
    for _, footing, result in told[1:]:
        assert footing.inlier.sum() == result.inlier_count > 20
        assert len(footing.px) == result.found_count
        assert result.inlier_count / footing.expected > 0.5
        assert rig.cam0.is_inside(footing.px).all()
        assert footing.mapped > 20
        assert 0 < result.median_nis < 3


def test_depths_are_those_that_stereo_measures(walk):
    rig, told = walk
    off = []
    for frame, footing, _ in told[1:]:
        known = footing.inlier & np.isfinite(footing.depth)
        assert known.sum() > 0.5 * footing.inlier.sum()
        px = footing.px[known]
        uv = rig.cam0.normalise(px.astype(np.float64))
        z = from_stereo(frame.image0, frame.image1, rig, px, uv, footing.depth[known])
        off += np.abs(z / footing.depth[known] - 1).tolist()
    assert np.nanmedian(off) < 0.02
    assert np.nanpercentile(off, 90) < 0.2
