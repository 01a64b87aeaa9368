"""Whether the room can serve one more agent."""

from __future__ import annotations

from dataclasses import replace

import pytest
from helpers.modelled_air import AT_ONCE_MS

from share.config import ControlConfig
from share.scheduling.qoe import QoeParameters
from share.scheduling.room_budget import AgentDemand, RoomBudget
from share.scheduling.room_capacity import TOLERATED_AIR_MS, RoomCapacity, crowded_air_ms
from share.scheduling.room_controller import AirtimeMeasurement, RoomController
from share.types import AgentKind
from share.wire.messages import Evaluation

S = 1_000_000_000
AR, ROBOT = AgentKind.AR, AgentKind.ROBOT
TERMS = {kind: QoeParameters.from_config(ControlConfig(), kind) for kind in (AR, ROBOT)}
KEYFRAME_MS = 54.0  # a full one


def room(headsets: int, robots: int, keyframe_ms: float = KEYFRAME_MS, other_ms: float = 60.0) -> RoomBudget:
    def agent(kind: AgentKind) -> AgentDemand:
        times = {"keyframe_s": keyframe_ms / 1e3, "arrival_s": (keyframe_ms - AT_ONCE_MS) / 1e3}
        times["delay_ms"] = other_ms + keyframe_ms
        return AgentDemand(
            TERMS[kind], wanted_hz=1.5, error_cm=1.0, drift_cm=0.5, hz=0.0, pose_hz=0.0, updated_ns=0, **times
        )

    kinds = [AR] * headsets + [ROBOT] * robots
    return RoomBudget({f"{kind}{k}": agent(kind) for k, kind in enumerate(kinds)})


def settled(budget: RoomBudget) -> RoomCapacity:
    return RoomCapacity().reassess(budget, 0).reassess(budget, 10 * S)


def test_a_room_with_air_takes_everyone() -> None:
    for budget in (RoomBudget(), room(8, 4), room(20, 10, keyframe_ms=5.0)):
        capacity = settled(budget)
        assert [capacity.objection(kind, 10 * S) for kind in AgentKind] == [None, None]
        assert capacity.displaced(AR, 10 * S) == ()


def test_robots_leave_first_the_newest_before_others() -> None:
    budget = room(37, 7)
    assert crowded_air_ms(budget, AR) > TOLERATED_AIR_MS
    capacity = settled(budget)
    assert capacity.objection(AR, 10 * S) is None
    assert "one more agent" in str(capacity.objection(ROBOT, 10 * S))
    assert capacity.displaced(AR, 10 * S)[0] == "robot43"
    assert set(capacity.displaced(AR, 10 * S)) < {f"robot{k}" for k in range(37, 44)}
    assert crowded_air_ms(budget, AR, capacity.displaced(AR, 10 * S)) <= TOLERATED_AIR_MS
    assert capacity.displaced(ROBOT, 10 * S) == ()


def test_a_room_full_of_headsets_says_so() -> None:
    capacity = settled(room(42, 0))
    said = str(capacity.objection(AR, 10 * S))
    assert said.startswith("no air for one more agent: a keyframe would take ")
    assert said.endswith(f"{TOLERATED_AIR_MS:.0f} ms at most")
    assert "seconds" in str(settled(room(60, 0)).objection(AR, 10 * S))


@pytest.mark.parametrize("honest", [1, 2, 6])
def test_an_agent_that_reports_bad_air_shuts_nobody_out(honest: int) -> None:
    liar = replace(room(1, 0).agents["ar0"], keyframe_s=9.0)
    budget = RoomBudget({**room(honest, 1).agents, "liar": liar})
    capacity = settled(budget)
    assert [capacity.objection(kind, 10 * S) for kind in AgentKind] == [None, None]
    assert capacity.displaced(AR, 10 * S) == ()


def test_a_short_pause_refuses_nobody() -> None:
    full, free = room(42, 0), room(8, 4)
    capacity = RoomCapacity().reassess(full, 0)
    assert capacity.objection(AR, 9 * S) is None
    recovered = capacity.reassess(free, 9 * S).reassess(full, 10 * S)
    assert recovered.objection(AR, 19 * S) is None
    assert recovered.objection(AR, 20 * S) is not None


def test_robots_alone_refuse_no_robot() -> None:
    assert settled(room(0, 60)).objection(ROBOT, 10 * S) is None


@pytest.mark.parametrize("gone_s", [1.0, 60.0])
def test_a_room_that_all_have_left_is_not_full(gone_s: float) -> None:
    controller, told = RoomController(), Evaluation(0, 2250.0, 1.0, 10.0, 5.0, 2000.0, 0.5)
    for k in range(400):
        air = AirtimeMeasurement(2000.0, 1996.0, 9 + k // 40, k)
        controller.grant(f"a{k % 20}", TERMS[AR], 1.5, told, air, k * S // 20)
    assert controller.objection(AR, 20 * S) is not None
    if gone_s < 3:
        assert controller.objection(AR, round((20 + gone_s) * S)) is not None
    else:
        assert controller.objection(AR, round((20 + gone_s) * S)) is None


@pytest.mark.parametrize("other_ms", [200.0, 270.0, 1e7])
@pytest.mark.parametrize(("headsets", "robots"), [(1, 0), (0, 1), (0, 4), (2, 3)])
def test_slow_or_distant_agents_shut_nobody_out(headsets: int, robots: int, other_ms: float) -> None:
    capacity = settled(room(headsets, robots, keyframe_ms=5.0, other_ms=other_ms))
    assert [capacity.objection(kind, 10 * S) for kind in AgentKind] == [None, None]
    assert capacity.displaced(AR, 10 * S) == ()


@pytest.mark.parametrize("kind", [AR, ROBOT])
def test_the_word_of_one_agent_about_the_air_refuses_nobody(kind: AgentKind) -> None:
    alone = room(int(kind is AR), int(kind is ROBOT), keyframe_ms=1e7)
    assert [settled(alone).objection(joining, 10 * S) for joining in AgentKind] == [None, None]
    assert settled(alone).displaced(AR, 10 * S) == ()


def test_no_robot_leaves_where_that_would_not_be_enough() -> None:
    for crowded in (room(42, 3), room(1, 3, keyframe_ms=300.0)):
        assert settled(crowded).objection(AR, 10 * S) is not None
        assert settled(crowded).displaced(AR, 10 * S) == ()
