"""Feature statistics of a keyframe, of both trackers."""

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

pytestmark = pytest.mark.long

Walk = tuple[list[Frame], list[tuple[Frame, FeatureStatistics, TrackResult]]]


@pytest.fixture(scope="module", params=["inertial", "visual"])
def walk(request, plain_session):
    """Rig, and of each keyframe: its own frame, its feature statistics and its result."""
    source = open_source(f"{plain_session}/ar1")
    rig = source.rig
    tracker = (
        InertialTracker(rig, InertialConfig())
        if request.param == "inertial"
        else VisualTracker(rig, TrackerConfig())
    )
    published = []
    for frame in read_frames(source, Config(), SequencerCounters()):
        result = tracker.track(frame)
        if result.keyframe_ready:
            before = tracker.feature_statistics()
            tracker.make_keyframe(frame)
            published.append((frame, before, result))
            again = tracker.feature_statistics()  # features added since do not count
            if request.param == "inertial":
                assert again.px.tobytes() == before.px.tobytes()
    return rig, published


def test_inliers_are_counted_and_in_the_image(walk):
    rig, published = walk
    assert len(published) >= 2
    for _, statistics, result in published[1:]:
        assert statistics.inlier.sum() == result.inlier_count > 20
        assert len(statistics.px) == result.found_count
        assert result.inlier_count / statistics.expected > 0.5
        assert rig.cam0.is_inside(statistics.px).all()
        assert statistics.mapped > 20
        assert 0 < result.median_nis < 3


def test_depths_agree_with_stereo(walk):
    rig, published = walk
    off = []
    for frame, statistics, _ in published[1:]:
        known = statistics.inlier & np.isfinite(statistics.depth)
        assert known.sum() > 0.5 * statistics.inlier.sum()
        px = statistics.px[known]
        uv = rig.cam0.normalise(px.astype(np.float64))
        z = from_stereo(frame.image0, frame.image1, rig, px, uv, statistics.depth[known])
        off += np.abs(z / statistics.depth[known] - 1).tolist()
    assert np.nanmedian(off) < 0.02
    assert np.nanpercentile(off, 90) < 0.2
