"""The plan on the status page."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import map_changes as mc
from helpers.hellos import hello_of
from helpers.many_runs import work_of

from share.geometry import se3
from share.mapping.corrections import map_assignment
from share.protocol.edge_events import AddKeyframe, AddRun, DropRun, MapperResult
from share.protocol.peer import RestoredRun
from share.runtime import room_plan
from share.runtime.room_plan import RoomPlan
from share.types import F64, AgentKind, TrackState
from share.wire.messages import PoseUpdate

ANN = mc.ANN


def at(x: float, y: float) -> F64:
    T = np.eye(4)
    T[:2, 3] = x, y
    return T


def walked(plan: RoomPlan, *steps: tuple[float, float], keyframe: int = 0) -> None:
    """Poses relative to a keyframe, all of them seen."""
    for x, y in steps:
        for _ in range(4):
            plan.add_poses({ANN: PoseUpdate(0, TrackState.OK, keyframe, at(x, y))})


def keyframe(plan: RoomPlan, id_: int, T_odom_body: F64, begins: bool = False) -> None:
    one = mc.keyframe(ANN, id_, first=begins).keyframe
    plan.add_effect(AddKeyframe(ANN, replace(one, T_odom_body=T_odom_body)))


def corrected(plan: RoomPlan, T_map_odom: F64, segment_keyframe: int = 0, map_id: str = "A") -> None:
    plan.add_result(MapperResult((map_assignment(ANN, map_id, T_map_odom, segment_keyframe),)))


@pytest.fixture
def plan() -> RoomPlan:
    out = RoomPlan()
    out.add_effect(AddRun(ANN, hello_of("ann", 1, AgentKind.ROBOT)))
    keyframe(out, 0, at(1.0, 0.0), begins=True)
    return out


def test_a_path_is_odometrys_in_the_map(plan: RoomPlan) -> None:
    walked(plan, (0.0, 0.0), (0.5, 0.0), (0.52, 0.0), (1.0, 0.0))
    assert plan.report() == {"agents": {}}  # not before its place is known
    corrected(plan, se3.exp(np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0])))
    ann = plan.report()["agents"]["ann"]
    assert ann["parts"] == [{"map_id": "A", "path": [[0.0, 1.0], [0.0, 1.5], [0.0, 2.0]]}]
    assert (ann["kind"], ann["map_id"], ann["position"]) == ("robot", "A", [0.0, 2.0])


def test_it_looks_where_its_camera_looks() -> None:
    T_body_cam0 = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    plan = RoomPlan()
    plan.add_effect(AddRun(ANN, hello_of("ann", 1, T=T_body_cam0)))
    keyframe(plan, 0, at(0.0, 0.0), begins=True)
    corrected(plan, se3.exp(np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0])))
    walked(plan, (1.0, 0.0))
    assert plan.report()["agents"]["ann"]["heading"] == 0.5


def test_each_segment_stays_in_its_map(plan: RoomPlan) -> None:
    corrected(plan, at(0.0, 0.0))
    walked(plan, (0.0, 0.0), (1.0, 0.0))
    keyframe(plan, 1, at(0.0, 0.0), begins=True)
    assert plan.report()["agents"]["ann"]["position"] is None
    corrected(plan, at(5.0, 5.0), segment_keyframe=1, map_id="B")
    corrected(plan, at(0.0, 9.0), segment_keyframe=0)  # a late one, of the segment before
    walked(plan, (1.0, 0.0), keyframe=1)
    ann = plan.report()["agents"]["ann"]
    assert ann["parts"] == [
        {"map_id": "A", "path": [[1.0, 9.0], [2.0, 9.0]]},
        {"map_id": "B", "path": [[6.0, 5.0]]},
    ]


def test_it_keeps_little(plan: RoomPlan) -> None:
    corrected(plan, at(0.0, 0.0))
    walked(plan, *((0.2 * k, 0.0) for k in range(3000)))
    path = plan.report()["agents"]["ann"]["parts"][0]["path"]
    assert len(path) <= 600 and path[-1][0] > 590 and path[0][0] > 100
    for k in range(1, 300):
        keyframe(plan, k, at(k, 0.0))
    walked(plan, (0.0, 77.0), keyframe=3)  # too old to be known
    assert plan.report()["agents"]["ann"]["position"][1] == 0.0


def test_a_run_that_comes_back_is_drawn_and_one_that_is_forgotten_is_not(plan: RoomPlan) -> None:
    corrected(plan, at(0.0, 0.0))
    walked(plan, (1.0, 0.0))
    plan.begin_session(None, [RestoredRun(ANN, hello_of("ann", 1), None)])
    assert "ann" in plan.report()["agents"]
    plan.add_effect(DropRun(ANN))
    assert plan.report() == {"agents": {}}
    plan.add_poses({ANN: PoseUpdate(0, TrackState.OK, 0, at(0.0, 0.0))})


def test_a_long_path_keeps_its_bends_and_its_newest_part(plan: RoomPlan) -> None:
    """Rounds of a circle of 1.5 m, as someone walks for a quarter of an hour: no chord may cut across."""
    corrected(plan, at(0.0, 0.0))
    angles = np.linspace(0.0, 50 * np.pi, 10_000)
    walked(plan, *(1.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)).tolist())
    path = np.array(plan.report()["agents"]["ann"]["parts"][0]["path"]) - [1.0, 0.0]  # its keyframe's place
    assert 100 < len(path) <= 600
    assert np.linalg.norm((path[1:] + path[:-1]) / 2, axis=1).min() > 1.48
    assert np.linalg.norm(path[-1] - [1.5, 0.0]) < 0.25


def test_agents_that_were_here_long_ago_cost_nothing(plan: RoomPlan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room_plan, "_MAX_AGENTS", 3)

    def come(count: int) -> int:
        """Runs of new names, each with a place, and then ann; return how much work a report is."""
        for k in range(count):
            key = f"n{count}x{k}-1"
            plan.add_effect(AddRun(key, hello_of(key.removesuffix("-1"), k)))
            plan.add_effect(AddKeyframe(key, mc.keyframe(key, 0, first=True).keyframe))
            plan.add_result(MapperResult((map_assignment(key, "A", at(0.0, 0.0), 0),)))
        keyframe(plan, count, at(0.0, 0.0))
        corrected(plan, at(0.0, 0.0))
        assert list(plan.report()["agents"]) == [f"n{count}x{count - 2}", f"n{count}x{count - 1}", "ann"]
        return work_of(plan.report)

    assert come(100) == come(10)


def test_a_run_that_comes_back_is_drawn(plan: RoomPlan) -> None:
    corrected(plan, at(0.0, 0.0))
    plan.add_effect(AddRun("ann-2", hello_of("ann", 2)))
    assert plan.report() == {"agents": {}}
    keyframe(plan, 1, at(1.0, 0.0))
    assert plan.report()["agents"]["ann"]["map_id"] == "A"
