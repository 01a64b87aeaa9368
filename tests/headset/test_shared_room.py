"""What pages are shown of the agents."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.many_runs import work_of

from share.geometry import se3
from share.headset.page_messages import MAX_POINTS
from share.headset.shared_room import SharedRoom
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import SavePoses
from share.types import F64, AgentKind, TrackState
from share.view import events as ev

MS = 10**6
EYE = np.eye(4)


def at(x: float, y: float = 0.0, yaw: float = 0.0) -> F64:
    return se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, yaw])), np.array([x, y, 0.0]))


class Playing(SharedRoom):
    """A room with ann (`ann-1`) and a robot (`tb-1`), each with a keyframe in a map of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.agent("ann", AgentKind.AR)
        self.agent("tb", AgentKind.ROBOT)
        self.take_poses()

    def agent(self, name: str, kind: AgentKind, run: int = 1, points: int = 3) -> None:
        key = f"{name}-{run}"
        self.apply(ev.RunArrived(key, name, kind, EYE, (0.8, 0.6)))
        self.apply(ev.KeyframeArrived(KeyframeKey(key, 0), True, EYE, np.ones((points, 3), np.float32)))
        self.apply(ev.CorrectionArrived(key, name.upper(), EYE, 0))

    def pose(self, run: str, T: F64, ms: float, state: TrackState = TrackState.OK, keyframe: int = 0) -> None:
        stamp_ns = round(ms * MS)
        self.apply(ev.PoseArrived(run, state, keyframe, T, 5.0, stamp_ns, stamp_ns + 105 * MS))


def test_a_pose_says_how_certain_it_is() -> None:
    room = Playing()
    for sigmas, said in (((0.0123456789, 0.004), (0.012346, 0.004)), ((None, None), (None, None))):
        room.apply(ev.PoseArrived("ann-1", TrackState.OK, 0, EYE, 5.0, MS, 2 * MS, *sigmas))
        (told,) = room.take_poses()
        assert (told["sigma_m"], told["sigma_rad"]) == said
    room.apply(ev.PoseArrived("ann-1", TrackState.LOST, -1, EYE, 5.0, 2 * MS, 3 * MS, 0.1, 0.1))
    assert room.take_poses()[0]["sigma_m"] is None  # there is no pose


def test_a_pose_is_in_the_map_with_its_time_and_motion() -> None:
    room = Playing()
    room.apply(ev.CorrectionArrived("ann-1", "A", at(10, 0, np.pi / 2), 0))
    for k in range(4):
        room.pose("ann-1", at(0.033 * k), 1000 + 33 * k)
    (told,) = room.take_poses()
    assert (told["agent"], told["kind"], told["state"], told["map_id"]) == ("ann", "ar", "OK", "A")
    assert told["position"] == pytest.approx([10, 0.099, 0], abs=1e-4)
    assert told["quaternion"] == pytest.approx([0, 0, np.sqrt(0.5), np.sqrt(0.5)], abs=1e-5)
    assert told["t_ms"] == 1099 + 100  # the way took 100 ms, by two clocks
    assert told["velocity"] == pytest.approx([0, 1, 0], abs=1e-4) and told["angular_velocity"] == [0, 0, 0]
    (again,) = room.poses()  # the robot has not said yet where it is
    assert room.take_poses() == [] and {k: v for k, v in again.items() if k != "path"} == told
    room.apply(ev.AgentsReported({"ann": {"run": "ann-1", "gone": False, "state": "OK", "rtt_ms": 20.0}}))
    room.pose("ann-1", at(0.132), 1132)
    assert room.take_poses()[0]["t_ms"] == 1132 + 90


def test_who_has_no_pose_or_is_gone_has_no_place() -> None:
    room = Playing()
    room.pose("ann-1", EYE, 0)
    room.pose("tb-1", EYE, 0)
    assert room.take_poses()[0]["position"] == [0, 0, 0]
    room.pose("ann-1", EYE, 33, TrackState.LOST)
    (told,) = room.take_poses()
    assert (told["state"], told["map_id"], told["position"], told["velocity"]) == ("LOST", None, None, None)
    room.pose("ann-1", EYE, 66)
    entry = {"run": "ann-1", "state": "OK", "rtt_ms": None}
    room.apply(ev.AgentsReported({"ann": entry | {"gone": True}}))
    (told,) = room.take_poses()
    assert (told["state"], told["map_id"]) == ("GONE", None)
    assert room.agents() == [{"name": "tb", "kind": "robot"}]
    room.apply(ev.AgentsReported({"ann": entry | {"gone": False, "state": "SILENT"}}))
    (told,) = room.take_poses()
    assert (told["state"], told["map_id"]) == ("SILENT", "ANN")


def test_a_pose_whose_keyframe_has_not_come_waits_for_it() -> None:
    room = Playing()
    room.pose("ann-1", at(1), 0)
    room.take_poses()
    room.pose("ann-1", at(9), 33, keyframe=7)
    assert [told["position"][0] for told in room.take_poses()] == [1]
    room.apply(ev.KeyframeArrived(KeyframeKey("ann-1", 7), False, at(2), np.ones((3, 3), np.float32)))
    room.pose("ann-1", at(1), 66, keyframe=7)
    assert [told["position"][0] for told in room.take_poses()] == [3]


def test_runs_of_a_map_file_are_not_there() -> None:
    room = SharedRoom()
    room.apply(ev.RunArrived("old-1", "old", AgentKind.AR, EYE, (0.8, 0.6)))
    room.apply(ev.KeyframeArrived(KeyframeKey("old-1", 0), True, EYE, np.ones((3, 3), np.float32)))
    room.apply(ev.MapsSolved(SavePoses((KeyframeKey("old-1", 0),), np.array([at(5)]), ("M",))))
    room.apply(ev.AgentsReported({"old": {"run": "old-1", "gone": True, "state": "OK", "rtt_ms": None}}))
    assert room.agents() == room.poses() == room.take_poses() == [] and len(room.points("M")) == 3


def test_of_an_agent_that_came_again_the_newest_run_counts() -> None:
    room = Playing()
    room.agent("ann", AgentKind.AR, run=2)
    room.pose("ann-1", at(1), 0)
    room.pose("ann-2", at(2), 0)
    assert [told["position"][0] for told in room.take_poses() if told["agent"] == "ann"] == [2]
    room.apply(ev.RunRemoved("ann-2"))
    assert [told["position"][0] for told in room.poses() if told["agent"] == "ann"] == [1]


def test_a_join_says_how_the_old_map_lies_in_the_new_one() -> None:
    room = Playing()
    T = at(3, 1, 0.5)
    room.apply(ev.CorrectionArrived("tb-1", "ANN", T, 0))
    (move,) = room.take_moves()
    assert (move.agent, move.old, move.new) == ("tb", "TB", "ANN")
    assert move.T_new_old == pytest.approx(T)
    assert room.take_moves() == []
    room.apply(ev.CorrectionArrived("tb-1", "ANN", at(3.1, 1, 0.5), 0))  # a correction is no move
    assert room.take_moves() == []


def test_a_path_is_told_in_its_map() -> None:
    room = Playing()
    for k in range(300):
        room.pose("tb-1", at(0.05 * k), 33 * k)
    (told,) = room.take_poses(has_paths=True)
    assert len(told["path"]) == 100 and told["path"][-1] == pytest.approx([14.95, 0, 0])


def test_points_of_a_map_are_its_keyframes_and_not_too_many() -> None:
    room = Playing()
    assert room.points("ANN") == pytest.approx(np.ones((3, 3))) and len(room.points("other")) == 0
    room.apply(ev.MapsSolved(SavePoses((KeyframeKey("ann-1", 0),), np.array([at(5)]), ("ANN",))))
    assert room.points("ANN") == pytest.approx(np.tile([6, 1, 1], (3, 1)))
    for k in range(1, 400):
        points = np.full((500, 3), k, np.float32)
        room.apply(ev.KeyframeArrived(KeyframeKey("ann-1", k), False, EYE, points))
    found = room.points("ANN")
    assert MAX_POINTS / 2 < len(found) <= MAX_POINTS and len(np.unique(found[:, 0])) > 390
    room.apply(ev.KeyframesRemoved(tuple(KeyframeKey("ann-1", k) for k in range(400))))
    assert len(room.points("ANN")) == 0


def test_a_session_that_begins_forgets_all() -> None:
    room = Playing()
    room.pose("ann-1", EYE, 0)
    room.apply(ev.SessionBegun())
    assert room.poses() == [] and room.take_poses() == [] and room.agents() == []


def test_agents_that_were_here_once_cost_nothing() -> None:
    def work(count: int) -> int:
        room = Playing()
        for k in range(count):
            room.agent(f"n{k}", AgentKind.AR)
            room.pose(f"n{k}-1", EYE, 1000)
        gone = {f"n{k}": {"run": f"n{k}-1", "gone": True, "state": "OK"} for k in range(count)}
        room.apply(ev.AgentsReported(gone, (), 0))
        assert len(room.take_poses()) == count
        room.pose("ann-1", at(1.0), 1033)
        assert [one["name"] for one in room.agents()] == ["ann"]
        room.pose("ann-1", at(1.0), 1066)
        return work_of(lambda: (room.agents(), room.poses(), room.take_poses()))

    assert work(100) == work(10)


def test_an_earlier_run_that_comes_back_is_shown_again() -> None:
    room = Playing()
    room.pose("ann-1", at(1.0), 1000)
    room.apply(ev.AgentsReported({"ann": {"run": "ann-1", "gone": True, "state": "OK"}}, (), 0))
    room.agent("ann", AgentKind.AR, run=2)
    room.pose("ann-2", at(2.0), 1033)
    both = {
        "ann": {"run": "ann-1", "gone": False, "state": "OK"},
        "ann/2": {"run": "ann-2", "gone": True, "state": "OK"},
    }
    room.apply(ev.AgentsReported(both, (), 0))
    (shown,) = room.poses()
    assert shown["position"] == [1.0, 0.0, 0.0]
