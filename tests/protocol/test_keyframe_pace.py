"""Which keyframes and poses an agent sends, by the edge's rate and window."""

from __future__ import annotations

import numpy as np

from share.protocol.keyframe_pace import KeyframePace
from share.types import OdometryKeyframe, View
from share.wire.messages import Rate

S = 1_000_000_000
CANDIDATE = OdometryKeyframe(np.eye(4), np.eye(4), np.eye(6) * 1e-6, np.zeros(3), 0.0, View.empty())


def sent(pace: KeyframePace, seconds: float, unacknowledged: int = 0, begin_s: float = 0.0) -> int:
    """How many of ten candidates a second are sent."""
    times = [round((begin_s + k / 10) * S) for k in range(round(10 * seconds))]
    return sum(pace.take(CANDIDATE, unacknowledged, now) for now in times)


def test_without_a_rate_everything_is_sent() -> None:
    pace = KeyframePace()
    assert sent(pace, 5.0, unacknowledged=500) == 50
    assert (pace.hz, pace.window) == (None, None)
    assert all(pace.take_pose(k * S // 30) for k in range(30))


def test_a_window_begins_with_one_keyframe() -> None:
    pace = KeyframePace()
    pace.set_rate(Rate(2.0, is_windowed=True), 0)
    assert pace.window == 1
    assert sent(pace, 0.1) == 1
    assert sent(pace, 5.0, unacknowledged=1, begin_s=1.0) == 0
    assert sent(pace, 10.0, begin_s=10.0) in (20, 21, 22)
    pace.acknowledge([30.0, 30.0, 30.0], 20 * S)
    assert pace.window == 3
    assert sent(pace, 2.0, unacknowledged=2, begin_s=21.0) > 0


def test_without_a_window_keyframes_wait_for_nothing_but_the_rate() -> None:
    pace = KeyframePace()
    pace.set_rate(Rate(2.0), 0)
    assert pace.window is None
    assert sent(pace, 10.0, unacknowledged=100) in (20, 21, 22)


def test_poses_are_thinned_and_come_back() -> None:
    pace = KeyframePace()
    pace.set_rate(Rate(1.0, True, pose_hz=10.0), 0)
    assert sum(pace.take_pose(k * S // 30) for k in range(300)) in range(95, 105)
    pace.set_rate(Rate(1.0, True), 11 * S)
    assert all(pace.take_pose(11 * S + k * S // 30) for k in range(30))


def test_a_new_session_of_the_edge_has_asked_for_nothing() -> None:
    pace = KeyframePace()
    pace.set_rate(Rate(0.0, True, pose_hz=1.0), 0)
    assert pace.hz == 0.1  # no edge silences an agent
    pace.begin_session(S)
    assert (pace.hz, pace.window) == (None, None)
    assert pace.take_pose(S) and pace.take_pose(S)


def test_a_welcome_may_hold_keyframes_for_a_while() -> None:
    pace = KeyframePace()
    pace.hold(250.0, S)
    assert pace.is_holding(S) and pace.is_holding(S + S // 4 - 1)
    assert not pace.is_holding(S + S // 4) and not pace.is_holding(2 * S)
    assert pace.take(CANDIDATE, 0, S)  # it is made, and sent later
