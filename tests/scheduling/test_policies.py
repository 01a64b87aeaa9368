"""Rates that each policy sets."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from share import config as settings
from share.config import ControlConfig
from share.scheduling.policies import POLICIES, AgentReport, PidState, Policy, pid_step
from share.scheduling.qoe import QoeParameters, qoe
from share.scheduling.room_budget import (
    JOINING_HZ,
    MIN_HZ,
    RateGrant,
    first_grant,
    scarce_grant,
)
from share.types import AgentKind
from share.wire.messages import Evaluation

S = 1_000_000_000
CONFIG = ControlConfig(  # wide bounds; a headset is content with 0.5 cm
    ar_gamma=1.2, ar_target=0.9, rate_min_hz=0.5, rate_max_hz=10.0, attribution=False
)
KINDS = {"ar": AgentKind.AR, "robot": AgentKind.ROBOT}
Plant = Callable[[dict[str, float], str], tuple[float, float]]  # rates, agent -> delay ms, error cm


def made(name: str, config: ControlConfig = CONFIG) -> Policy:
    return POLICIES[name](config)


def settled(plant: Plant, seconds: float = 90) -> dict[str, float]:
    """Mean rates under `share` in the last third; each agent is evaluated as often as it sends."""
    policy, rng = made("share"), np.random.default_rng(1)
    rates, due = dict.fromkeys(KINDS, 5.0), dict.fromkeys(KINDS, 0.0)
    late: dict[str, list[float]] = {agent: [] for agent in KINDS}
    while (now := min(due.values())) < seconds:
        agent = min(due, key=lambda a: due[a])
        delay_ms, error_cm = plant(rates, agent)
        noisy = delay_ms * np.exp(rng.normal(0, 0.1)), error_cm * np.exp(rng.normal(0, 0.1))
        rates[agent] = policy.rate(agent, KINDS[agent], *noisy, round(now * S)) or 0.0
        due[agent] = now + 1 / rates[agent]
        if now > seconds * 2 / 3:
            late[agent].append(rates[agent])
    return {agent: float(np.mean(values)) for agent, values in late.items()}


def test_every_configurable_policy_exists() -> None:
    assert list(POLICIES) == list(settings.POLICY_NAMES)


@pytest.mark.parametrize(
    ("name", "gated", "alike", "raw"),
    [
        ("share", True, False, False),
        ("share-paper", True, False, False),
        ("covins-g", False, True, False),
        ("linear", False, True, False),
        ("equal", True, True, False),
        ("random", True, False, False),
        ("fixed", True, True, False),
        ("streamed", False, True, True),
    ],
)
def test_properties_of_policies(name: str, gated: bool, alike: bool, raw: bool) -> None:
    policy = made(name)
    assert (policy.has_merge_gate, policy.treats_alike, policy.streams_frames) == (gated, alike, raw)


@pytest.mark.parametrize("name", ["covins-g", "streamed"])
def test_policies_without_a_rate_limit(name: str) -> None:
    assert made(name).rate("ann", AgentKind.AR, 500, 3, 0) is None


@pytest.mark.parametrize(
    ("delay_ms", "hz"), [(0, 10), (20, 10), (265, 7.5), (510, 5), (755, 2.5), (990, 0.5), (1e9, 0.5)]
)
def test_linear_depends_on_the_delay_alone(delay_ms: float, hz: float) -> None:
    policy = made("linear")
    for kind in AgentKind:
        assert policy.rate("ann", kind, delay_ms, None, 0) == pytest.approx(hz, abs=1e-12)


def test_equal_rates_a_robot_as_a_headset() -> None:
    equal, share = made("equal"), made("share")
    for t in range(5):
        at = (60.0, 0.3, t * S)
        assert equal.rate("robot", AgentKind.ROBOT, *at) == share.rate("ann", AgentKind.AR, *at)


def test_a_setting_gives_a_robot_the_ar_form() -> None:
    policy = made("share", settings.load_config("control: {agents: {bob: {form: ar}}}").control)
    for t in range(3):
        at = (60.0, 0.3, t * S)
        assert policy.rate("bob", AgentKind.ROBOT, *at) == policy.rate("ann", AgentKind.AR, *at)
    assert policy.rate("carl", AgentKind.ROBOT, 60, 0.3, 0) != policy.rate("bob", AgentKind.ROBOT, 60, 0.3, 0)


def test_random_is_determined_by_its_seed() -> None:
    def rates(seed: int) -> list[float | None]:
        policy = made("random", replace(CONFIG, random_seed=seed))
        return [policy.rate("ann", AgentKind.AR, 20, 0.1 * t, t * S // 2) for t in range(1, 9)]

    assert rates(1) == rates(1) != rates(2)


def test_agents_are_independent_and_can_be_forgotten() -> None:
    policy, alone = made("share"), made("share")
    for t in range(6):
        policy.rate("bob", AgentKind.ROBOT, 900, 5, t * S)
        assert policy.rate("ann", AgentKind.AR, 20, 0.1, t * S) == alone.rate(
            "ann", AgentKind.AR, 20, 0.1, t * S
        )
    policy.forget("ann")
    policy.forget("nobody")
    assert policy.rate("ann", AgentKind.AR, 20, 0.1, 9 * S) == made("share").rate(
        "ann", AgentKind.AR, 20, 0.1, 0
    )


@given(
    st.sampled_from(["share", "share-paper", "linear", "equal", "random", "fixed"]),
    st.lists(
        st.tuples(
            st.sampled_from(["ann", "bob"]),
            st.floats(0, 1e6),
            st.none() | st.floats(0, 1e6),
            st.floats(-1, 9),
        ),
        max_size=20,
    ),
    st.booleans(),
)
def test_rates_stay_within_bounds(
    name: str, said: list[tuple[str, float, float | None, float]], signed: bool
) -> None:
    policy, now = made(name, replace(CONFIG, signed_penalty=signed)), 0.0
    for agent, delay_ms, error_cm, passed in said:
        now += passed
        rate = policy.rate(
            agent, AgentKind.AR if agent == "ann" else AgentKind.ROBOT, delay_ms, error_cm, round(now * S)
        )
        assert rate is not None and CONFIG.rate_min_hz <= rate <= CONFIG.rate_max_hz


def test_rates_settle_where_more_keyframes_mean_less_error() -> None:
    rates = settled(lambda rates, agent: (20 if agent == "ar" else 100, 0.3 + 0.6 / rates[agent]))
    assert 2 < rates["ar"] < 4.5 and 0.7 < rates["robot"] < 1.5


def test_a_robot_gives_way_to_a_headset_at_a_busy_edge() -> None:
    rates = settled(lambda rates, agent: (20 + 300 / (40 - sum(rates.values())), 0.4 + 0.4 / rates[agent]))
    assert rates["ar"] > 9 and rates["robot"] < 1


def test_where_keyframes_alone_make_the_delay_all_rates_rise() -> None:
    """As in the paper, the agent with the lower QoE sends more: see docs/understand/scheduling.md."""
    rates = settled(lambda rates, agent: (20 + 2000 / (26 - sum(rates.values())), 0.4))
    assert min(rates.values()) > 9


def test_by_attribution_delay_lowers_the_rate_and_error_raises_it() -> None:
    def last(delay_ms: float, error_cm: float, kind: AgentKind, attribution: bool) -> float:
        policy = made("share", replace(CONFIG, attribution=attribution))
        for t in range(30):
            rate = policy.rate("ann", kind, delay_ms if t else 15.0, error_cm, t * S)
        assert rate is not None
        return rate

    for kind, delay_ms in ((AgentKind.AR, 60.0), (AgentKind.ROBOT, 800.0)):
        assert last(delay_ms, 0.3, kind, attribution=False) == CONFIG.rate_max_hz
        assert last(delay_ms, 0.3, kind, attribution=True) == CONFIG.rate_min_hz
        assert last(15.0, 3.0, kind, attribution=True) == CONFIG.rate_max_hz
        assert last(15.0, 0.1, kind, attribution=True) == last(15.0, 0.1, kind, attribution=False) < 6


def test_by_attribution_the_base_delay_does_not_lower_the_rate() -> None:
    """A delay of 30 ms at any rate: the rate is then that of the error alone."""

    def last(reported: list[tuple[float, float]]) -> float | None:
        policy = made("share", replace(CONFIG, attribution=True))
        for t, (delay_ms, error_cm) in enumerate(reported):
            rate = policy.rate("ann", AgentKind.AR, delay_ms, error_cm, t * S)
        return rate

    for delay_ms in (15.0, 22.0, 25.0, 30.0, 60.0):
        assert last([(delay_ms, 0.1)] * 60) == CONFIG.rate_min_hz
        assert last([(delay_ms, 2.0)] * 60) == CONFIG.rate_max_hz
    waits = [(30.0, 0.6)] * 60 + [(90.0, 0.6)] * 40
    assert last(waits[:60]) == CONFIG.rate_max_hz and last(waits) == CONFIG.rate_min_hz


def report(kind: AgentKind, now_s: float, evaluation: Evaluation, keyframes: int = 9) -> AgentReport:
    return AgentReport(kind, evaluation, round(now_s * S), keyframes, poses=round(30 * now_s))


def test_share_paper_steps_once_a_keyframe_by_round_trip_and_processing() -> None:
    """To the digit that of the equations without attribution, whatever the delay until corrections."""
    paper, states = made("share-paper", replace(CONFIG, attribution=True)), PidState(CONFIG.rate_max_hz)
    for k in range(1, 30):
        delay_ms, error_cm = 20.0 + k, 0.2 + 0.1 * k
        told = Evaluation(k, 9e3, error_cm, track_ms=12.0, rtt_ms=delay_ms - 12.0, ack_ms=5e3)
        quality = qoe(delay_ms, error_cm, QoeParameters.from_config(CONFIG, AgentKind.AR))
        states = pid_step(states, CONFIG.ar_target - quality, round(0.7 * k * S), CONFIG)
        assert paper.evaluate("ann", report(AgentKind.AR, 0.7 * k, told)) == RateGrant(states.rate_hz)
        between = replace(told, keyframe=-1)
        assert paper.evaluate("ann", report(AgentKind.AR, 0.7 * k + 0.3, between)) == RateGrant(
            states.rate_hz
        )
    assert paper.first_grant("ann", AgentKind.AR, 0) is None and not paper.is_windowed


def test_fixed_is_one_rate_for_all_from_the_first_keyframe_on() -> None:
    fixed = made("fixed", replace(CONFIG, fixed_rate_hz=0.7))
    for kind in AgentKind:
        assert fixed.first_grant("ann", kind, 0) == RateGrant(0.7)
        for delay_ms in (10.0, 9e3):
            told = Evaluation(0, delay_ms, 3.0)
            assert fixed.evaluate("ann", report(kind, 1.0, told)) == RateGrant(0.7)
    small = made("fixed", replace(CONFIG, fixed_rate_hz=0.7, fixed_jpeg_quality=20))
    assert small.first_grant("ann", AgentKind.AR, 0) == RateGrant(0.7, None, 20)
    capped = made("fixed", replace(CONFIG, rate_min_hz=1.0, rate_max_hz=1.2))
    assert capped.first_grant("ann", AgentKind.AR, 0) == RateGrant(1.2)
    with pytest.raises(ValueError, match="fixed_rate_hz: 50 Hz is above rate_max_hz, 10 Hz; raise that too"):
        replace(CONFIG, fixed_rate_hz=50.0)


def test_share_begins_slowly_and_yields_where_keyframes_take_long() -> None:
    share, least = (
        made("share", ControlConfig()),
        scarce_grant(AgentKind.AR, MIN_HZ[AgentKind.AR]),
    )
    assert share.is_windowed and share.first_grant("ann", AgentKind.AR, 0) == first_grant(AgentKind.AR)
    assert share.first_grant("bob", AgentKind.ROBOT, 0) == first_grant(AgentKind.ROBOT)
    slow = Evaluation(0, 400.0, 1.0, track_ms=10.0, rtt_ms=10.0, ack_ms=310.0)
    quick = Evaluation(0, 45.0, 1.0, track_ms=10.0, rtt_ms=5.0, ack_ms=8.0)
    assert share.evaluate("ann", report(AgentKind.AR, 1.0, slow)) == least
    alone = replace(report(AgentKind.AR, 1.0, slow), is_placed=False)  # it shares a map with nobody yet
    assert made("share", ControlConfig()).evaluate("ann", alone).hz > JOINING_HZ
    disk = replace(report(AgentKind.AR, 1.0, slow), held_ms=299.0)  # the edge's disk, not the air
    assert made("share", ControlConfig()).evaluate("ann", disk) != least
    for k in range(2, 32):
        grant = share.evaluate("ann", report(AgentKind.AR, float(k), quick, keyframes=9 + k))
    assert grant is not None and grant.pose_hz is None and grant.hz >= ControlConfig().rate_min_hz
