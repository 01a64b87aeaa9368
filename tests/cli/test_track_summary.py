"""The closing lines of `share track` say which poses are less certain."""

from __future__ import annotations

from typing import Any

import pytest

from share.cli.track import _summary
from share.metrics.frame_log import RunLog
from share.odometry.health import MIN_POSE_FEATURES
from share.types import TrackState


def report(*states: TrackState) -> dict[str, Any]:
    log = RunLog()
    for k, state in enumerate(states):
        log.add(k * 50_000_000, 2.0, state, False)
    log.add_decode_time(0.1)
    return log.report()


@pytest.mark.parametrize(
    ("states", "line"),
    [
        ([TrackState.OK, TrackState.OK], None),
        ([TrackState.OK, TrackState.LOST], None),
        (
            [TrackState.WEAK, TrackState.INERTIAL_ONLY, TrackState.OK, TrackState.INERTIAL_ONLY],
            "of the frames with a pose: few features in 1, "
            f"IMU alone (fewer than {MIN_POSE_FEATURES} features accepted) in 2",
        ),
        ([TrackState.OK, TrackState.VISION_ONLY], "of the frames with a pose: images alone (no IMU) in 1"),
    ],
)
def test_less_certain_poses_are_counted(states: list[TrackState], line: str | None) -> None:
    lines = _summary(report(*states), None).splitlines()
    assert [one for one in lines if one.startswith("of the frames with a pose")] == ([line] if line else [])
