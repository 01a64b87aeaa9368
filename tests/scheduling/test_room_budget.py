"""The room's budget: who sends how much where the air is short."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.modelled_air import AT_ONCE_MS, Air
from hypothesis import given
from hypothesis import strategies as st

from share.config import AgentQoe, ControlConfig
from share.scheduling.qoe import QoeParameters, QoeTable, qoe
from share.scheduling.room_budget import (
    JOINING_HZ,
    MIN_HZ,
    OTHER_HZ,
    SCARCE_POSE_HZ,
    AgentDemand,
    RateGrant,
    RoomBudget,
    first_grant,
    message_s,
    scarce_grant,
)
from share.scheduling.room_controller import AirtimeMeasurement, RoomController
from share.types import AgentKind
from share.wire.messages import Evaluation

S = 1_000_000_000
AR, ROBOT = AgentKind.AR, AgentKind.ROBOT
TERMS = {kind: QoeParameters.from_config(ControlConfig(), kind) for kind in (AR, ROBOT)}


def agent(kind: AgentKind = AR, keyframe_ms: float = 40.0, **given: float) -> AgentDemand:
    fields = {"wanted_hz": 1.5, "delay_ms": 60 + keyframe_ms, "error_cm": 1.5, "drift_cm": 1.0} | given
    rates = {"hz": 1.0, "pose_hz": 30.0, "updated_ns": 0}
    air = {"keyframe_s": keyframe_ms / 1e3, "arrival_s": max(0.0, keyframe_ms - AT_ONCE_MS) / 1e3}
    return AgentDemand(qoe=TERMS[kind], **(rates | air | fields))  # type: ignore[arg-type]


def room(*agents: AgentDemand) -> RoomBudget:
    return RoomBudget({f"a{k}": one for k, one in enumerate(agents)})


def test_an_agent_whose_air_is_not_known_starts_slowly() -> None:
    told = Evaluation(0, 20.0, 1.0)
    airs = [AirtimeMeasurement(0.0, 0.0, n, 0) for n in range(3)]
    grants = [RoomController().grant("a0", TERMS[AR], 5.0, told, air, S) for air in airs]
    assert grants == [first_grant(AR), first_grant(AR), RateGrant(5.0)]


def test_with_ample_air_everyone_gets_what_it_wants() -> None:
    air = Air(2.0, (AR, AR, ROBOT) * 4)
    air.play(20)
    assert all(grant == RateGrant(1.5) for grant in air.grants)


def test_where_the_air_is_short_robots_yield_and_poses_are_thinned() -> None:
    air = Air(34.0, (AR, AR, ROBOT) * 4)
    air.play(20)
    for kind, grant in zip(air.kinds, air.grants, strict=True):
        assert grant.pose_hz == SCARCE_POSE_HZ[kind]
        assert MIN_HZ[kind] <= grant.hz <= 1.5
    headsets, robots = (
        [g.hz for k, g in zip(air.kinds, air.grants, strict=True) if k is kind] for kind in (AR, ROBOT)
    )
    assert max(robots) < min(headsets)
    assert air.load() < 0.4


@pytest.mark.parametrize(("alone_ms", "is_small"), [(2.0, False), (6.0, False), (18.0, True), (34.0, True)])
def test_pictures_are_small_where_full_ones_take_long_and_stay_so(alone_ms: float, is_small: bool) -> None:
    """Though small ones take little: at 18 ms the air is not short any more. Two headsets and a robot."""
    air = Air(alone_ms, (AR, AR, ROBOT), noise=0.1)
    air.play(20)
    for _ in range(40):
        air.play(1)
        assert [grant.jpeg_quality is not None for grant in air.grants] == [is_small] * 3


def test_pictures_are_full_again_after_the_air_clears() -> None:
    air = Air(34.0, (AR, AR, ROBOT))
    air.play(20)
    air.alone_ms = 3.0
    air.play(20)
    assert all(grant == RateGrant(1.5) for grant in air.grants)


@pytest.mark.parametrize("alone_ms", [18.0, 34.0, 54.0])
def test_rates_settle(alone_ms: float) -> None:
    """Within 10 s, though every 0.5 s all react to what all did: headsets move by one step, robots by two at
    most."""
    air = Air(alone_ms, (AR, AR, ROBOT) * 4)
    air.play(60)
    for kind, rates in zip(air.kinds, zip(*air.history[20:], strict=True), strict=True):
        assert max(rates) - min(rates) <= (0.25 if kind is AR else 0.5)


def test_after_the_air_clears_all_get_what_they_want_again() -> None:
    air = Air(34.0, (AR, AR, ROBOT) * 2)
    air.play(30)
    assert min(grant.hz for grant in air.grants) < 1.5
    air.alone_ms = 3.0
    air.play(15)
    assert all(grant == RateGrant(1.5) for grant in air.grants)


def test_time_on_the_air_follows_from_what_is_measured_at_any_load() -> None:
    """Small messages of the load included: poses, and what agent and edge say beside."""
    for load in (0.1, 0.5, 0.9):
        messages = agent(pose_hz=5.0).messages_hz * message_s(0.04)
        measured = agent(keyframe_ms=40 / (1 - load), hz=(load - messages) / 0.04, pose_hz=5.0)
        assert room(measured).airtime_s(measured) == pytest.approx(0.04)
        assert room(measured).load == pytest.approx(load)


def test_slow_air_that_few_share_is_not_short() -> None:
    """At 15 Mbit/s a keyframe takes 18 ms, however few send; at 5 Mbit/s one agent has what it wants."""
    assert not room(*[agent(keyframe_ms=18.5)] * 2).is_short()
    assert room(*[agent(keyframe_ms=40.0)] * 12).is_short()
    assert room(agent(keyframe_ms=54.0)).allocate()[0]["a0"].hz == 1.5


@pytest.mark.parametrize("honest", [2, 4, 8])
def test_an_agent_that_claims_to_take_no_air_gains_little_and_delays_nobody(honest: int) -> None:
    """On 60 ms of air; it claims to drift as well, so that a step gains it more than others."""
    others = [agent(keyframe_ms=70.0, wanted_hz=5.0, pose_hz=5.0, hz=0.5)] * honest
    liar = replace(others[0], keyframe_s=0.0, delay_ms=60.0, error_cm=5.0, drift_cm=5.0)
    usual, granted = room(*others, others[0]).allocate()[0], room(*others, liar).allocate()[0]
    assert granted[f"a{honest}"].hz <= 6 * granted["a0"].hz
    alone_s = room(*others).airtime_s(others[0])

    def load(grants: dict[str, RateGrant]) -> float:
        return sum(alone_s * g.hz + (SCARCE_POSE_HZ[AR] + 8) * message_s(alone_s) for g in grants.values())

    assert (1 - load(usual)) / (1 - load(granted)) < 1.25


def test_an_agent_has_a_faster_link_if_the_edge_sees_it() -> None:
    others = [agent()] * 3
    fast, claims = agent(keyframe_ms=8.0), agent(keyframe_ms=0.0, arrival_s=0.036)
    budget = room(*others, fast, claims)
    own, claimed = (budget.airtime_s(budget.agents[name]) for name in ("a3", "a4"))
    assert claimed == pytest.approx(budget.median_airtime_s)
    assert budget.median_airtime_s is not None and 0.2 < own / budget.median_airtime_s < 0.25


def test_more_goes_to_whom_it_gains_more() -> None:
    """Two headsets on 18 ms of air; one drifts."""
    drifts, is_still = (
        agent(keyframe_ms=18.5, wanted_hz=4.0, drift_cm=1.4),
        agent(keyframe_ms=18.5, wanted_hz=4.0, drift_cm=0.1),
    )
    granted = room(drifts, is_still, *[agent(keyframe_ms=18.5, wanted_hz=4.0, drift_cm=0.1)] * 2).allocate()[
        0
    ]
    assert granted["a0"].hz > granted["a1"].hz


def test_a_robot_delays_no_headset_unless_it_has_the_ar_form() -> None:
    """`control.agents` gives the latency-critical one that form."""
    bob = ControlConfig(agents={"bob": AgentQoe(form="ar")})
    urgent = replace(agent(ROBOT), qoe=QoeParameters.from_config(bob, ROBOT, "bob"))
    granted = room(agent(AR), agent(ROBOT), urgent).allocate()[0]
    assert granted["a1"] == scarce_grant(ROBOT, MIN_HZ[ROBOT])
    assert granted["a2"] == granted["a0"]
    among_robots = room(agent(ROBOT), agent(ROBOT)).allocate()[0]
    assert among_robots["a0"].hz > MIN_HZ[ROBOT]


def test_an_agent_that_shares_a_map_with_nobody_has_the_air_that_is_idle() -> None:
    """Its keyframes are what it is recognised by; at half of the air they take twice as long as alone."""
    robot = agent(ROBOT, 80.0, wanted_hz=20.0)
    alone = room(*[agent(AR, 80.0)] * 6, replace(robot, is_placed=False))
    placed, joins = (budget.allocate()[0] for budget in (room(*[agent(AR, 80.0)] * 6, robot), alone))
    assert placed["a6"].hz == MIN_HZ[ROBOT] and 2 * JOINING_HZ < joins["a6"].hz < 20.0
    assert all(joins[f"a{k}"] == placed[f"a{k}"] for k in range(6))
    air_s = alone.airtime_s(robot)
    load = sum(air_s * grant.hz + (grant.pose_hz + OTHER_HZ) * message_s(air_s) for grant in joins.values())
    assert 0.49 < load <= 0.5


def test_agents_that_are_silent_or_have_left_take_no_air() -> None:
    budget = room(agent(), agent()).with_report("a2", agent(updated_ns=10 * S))
    assert list(budget.agents) == ["a2"]
    assert list(budget.without("a2").agents) == []
    assert list(budget.without("nobody").agents) == ["a2"]


def test_measurements_are_filtered() -> None:
    before = agent(keyframe_ms=40.0)
    after = RoomBudget({"a0": before}).with_report("a0", agent(keyframe_ms=400.0, updated_ns=S // 2))
    assert 0.04 < after.agents["a0"].keyframe_s < 0.06  # of ten times as long one counts little
    later = after
    for second in range(1, 21):
        later = later.with_report("a0", agent(keyframe_ms=120.0, updated_ns=second * S))
    assert later.agents["a0"].keyframe_s == pytest.approx(0.12, rel=0.05)
    assert RoomBudget().with_report("a0", agent(keyframe_ms=400.0)).agents["a0"].keyframe_s == 0.4
    again = RoomBudget().with_report("a0", agent(keyframe_ms=400.0, updated_ns=5 * S), before)
    assert again.agents["a0"].keyframe_s < 0.12


numbers = st.floats(0, 1e6)
agents = st.builds(
    agent,
    st.sampled_from([AR, ROBOT]),
    st.floats(0, 1e7),
    wanted_hz=st.floats(0.1, 5.0),
    delay_ms=numbers,
    error_cm=st.none() | numbers,
    drift_cm=numbers,
    arrival_s=st.floats(0, 1e4),
    hz=st.floats(0, 100),
    pose_hz=st.floats(0, 200),
)


@given(st.lists(agents, min_size=1, max_size=6))
def test_no_report_breaks_it(reported: list[AgentDemand]) -> None:
    budget = room(*reported)
    assert budget.is_short() in (True, False)
    for name, grant in budget.allocate()[0].items():
        one = budget.agents[name]
        assert min(MIN_HZ[one.qoe.form], one.wanted_hz) <= grant.hz <= one.wanted_hz


def test_all_at_once_have_the_qoe_of_each():
    rng = np.random.default_rng(0)
    terms = [replace(TERMS[kind], signed=signed) for kind in (AR, ROBOT) for signed in (False, True)] * 50
    delay_ms, error_cm = rng.uniform(0, 900, len(terms)), rng.uniform(0.01, 4, len(terms))
    error_cm[::7] = np.nan
    expected = [
        qoe(d, None if np.isnan(e) else e, one) for d, e, one in zip(delay_ms, error_cm, terms, strict=True)
    ]
    np.testing.assert_allclose(QoeTable.of(terms).qoe(delay_ms, error_cm), expected, rtol=1e-12)
