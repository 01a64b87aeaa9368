"""The agent's pose stream as the bridge reads it."""

import contextlib
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from share.errors import WireError
from share.geometry.se3 import from_rt, so3_exp
from share.robot.pose_message import parse_pose_message
from share.runtime.pose import Pose
from share.runtime.pose_feed import PoseMessages
from share.types import TrackState

T = from_rt(so3_exp(np.array([0.1, -1.5, 0.3])), np.array([1.0, 2.0, 0.3]))


def message(**changed: object) -> bytes:
    cov = np.diag([1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 0.09])  # 30 cm along the body's z, which lies on the floor
    pose = Pose(5, TrackState.WEAK, T, T, "ann-1/0", cov=cov, map_cov=cov, age_ms=12.5, is_connected=True)
    return json.dumps({**json.loads(PoseMessages("bot").of_pose(pose)), **changed}).encode()


def test_what_an_agent_sends_is_what_the_bridge_gets():
    pose = parse_pose_message(message())
    assert (pose.agent, pose.sequence, pose.state, pose.map_id) == ("bot", 0, TrackState.WEAK, "ann-1/0")
    assert np.allclose(pose.T_map_body, T, atol=1e-6)
    assert (pose.age_ns, pose.has_edge) == (12_500_000, True)
    floor = (T[:3, :3] @ np.diag([1e-4, 1e-4, 0.09]) @ T[:3, :3].T)[:2, :2]
    assert pose.sigma_m == pytest.approx(np.sqrt(np.linalg.eigvalsh(floor)[-1]), rel=1e-2)


def test_a_frame_without_a_pose():
    pose = parse_pose_message(PoseMessages("bot").of_state(7, TrackState.LOST).encode())
    assert (pose.state, pose.T_map_body, pose.sigma_m, pose.has_edge) == (TrackState.LOST, None, None, None)


@pytest.mark.parametrize(
    "changed",
    [
        {"schema": 2},
        {"state": "FINE"},
        {"sequence": "1"},
        {"age_ms": -1.0},
        {"age_ms": float("nan")},
        {"map": {"position": [0, 0, 0]}},
        {"map": {"position": [0, 0, float("nan")], "quaternion": [0, 0, 0, 1], "covariance": None}},
        {"map": {"position": [0, 0, 0], "quaternion": [0, 0, 0, 0], "covariance": None}},
        {"map": {"position": [0, 0, 0], "quaternion": [0, 0, 0, 1], "covariance": [1.0]}},
        {"map": {"position": [0, 0, 0], "quaternion": [0, 0, 0, 1], "covariance": [-1.0] * 21}},
        {"map_id": 5},
    ],
)
def test_what_no_agent_sends_is_refused(changed):
    with pytest.raises(WireError):
        parse_pose_message(message(**changed))


@given(st.binary(max_size=300))
def test_bytes_of_anybody(data):
    with pytest.raises(WireError):
        parse_pose_message(data)


values = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.lists(st.floats())


@given(st.sampled_from(sorted(json.loads(message()))), values)
def test_a_key_of_anybody(key, value):
    with contextlib.suppress(WireError):
        parse_pose_message(message(**{key: value}))


@pytest.mark.parametrize("map_id", ["", "m" * 97, "a\u202eb"])
def test_a_map_that_no_wire_would_pass_on_is_no_message(map_id):
    with pytest.raises(WireError, match="map_id"):
        parse_pose_message(message(map_id=map_id))
