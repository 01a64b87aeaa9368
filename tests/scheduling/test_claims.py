"""What an agent gains that says that its keyframes take no air, or that it is fast."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.modelled_air import AT_ONCE_MS

from share.config import ControlConfig
from share.scheduling.policies import AgentReport, SharePolicy
from share.scheduling.room_budget import OTHER_HZ, message_s
from share.types import F64, AgentKind
from share.wire.messages import Evaluation

S, STEP_S = 1_000_000_000, 0.5
AR = AgentKind.AR
Claim = Callable[[Evaluation], Evaluation]
CLAIMS: dict[str, Claim] = {
    "no air": lambda true: replace(true, ack_ms=0.0),
    "no delay": lambda true: replace(true, delay_ms=0.0),
    "neither": lambda true: replace(true, ack_ms=0.0, delay_ms=0.0, track_ms=0.0, rtt_ms=0.0),
    "a long way": lambda true: replace(true, rtt_ms=true.ack_ms),
    "a fast machine": lambda true: replace(true, delay_ms=max(0.0, true.delay_ms - 60)),
    "much of all": lambda true: replace(true, ack_ms=1e5, delay_ms=1e6),
}


def rates(air_ms: list[float], claim: Claim | None = None, other_ms: float = 60.0) -> F64:
    """Return what headsets are granted on one air, Hz, the mean of the last 20 s of 60. air_ms: T of each;
    claim: of the last."""
    policy = SharePolicy(ControlConfig(rate_min_hz=5.0))  # all want as much as they may
    names = [f"a{k}" for k in range(len(air_ms))]
    grants, sent, history = [policy.first_grant(name, AR, 0) for name in names], np.zeros((len(names), 2)), []
    for step in range(1, 121):
        load = 0.0
        for T, grant in zip(air_ms, grants, strict=True):
            assert grant is not None
            load += T / 1e3 * grant.hz + (OTHER_HZ + (grant.pose_hz or 30.0)) * message_s(T / 1e3)
        for k, (T, grant) in enumerate(zip(air_ms, grants, strict=True)):
            assert grant is not None
            sent[k] += STEP_S * grant.hz, STEP_S * (grant.pose_hz or 30.0)
            taken_ms = T / (1 - min(0.95, load))
            told = Evaluation(0, other_ms + taken_ms, 2.0, 10.0, 5.0, 5 + taken_ms, 1.5)
            if claim is not None and k == len(air_ms) - 1:
                told = claim(told)
            seen_ms, counts = max(0.0, taken_ms - AT_ONCE_MS), [int(n + k / 2) for n in sent[k]]
            now_ns = round(step * STEP_S * S) + k
            report = AgentReport(AR, told, now_ns, *counts, arrival_ms=seen_ms)
            grants[k] = policy.evaluate(names[k], report)
        history.append([grant.hz for grant in grants if grant is not None])
    return np.mean(history[-40:], axis=0)


@cache
def usual_rates(air_ms: float, agents: int) -> F64:
    """Where all say what is."""
    return rates([air_ms] * agents)


@pytest.mark.parametrize("claim", CLAIMS.values(), ids=CLAIMS)
@pytest.mark.parametrize("air_ms", [20.0, 34.0, 54.0, 80.0])
def test_of_two_one_gains_nothing_over_the_other_by_a_claim(air_ms: float, claim: Claim) -> None:
    """Before, up to 3.3 times the other's rate."""
    honest, liar = rates([air_ms] * 2, claim)
    usual = usual_rates(air_ms, 2)
    assert liar <= 1.1 * honest
    assert honest >= 0.9 * usual[0]


@pytest.mark.parametrize("claim", CLAIMS.values(), ids=CLAIMS)
def test_of_five_neither(claim: Claim) -> None:
    *honest, liar = rates([34.0] * 5, claim)
    usual = usual_rates(34.0, 5)
    assert liar <= 1.1 * max(honest) and min(honest) >= 0.9 * min(usual)


def test_an_honest_agent_with_a_fast_link_has_what_it_wants() -> None:
    """Its keyframes take a tenth of the other's air, which the edge sees."""
    assert rates([54.0, 5.4])[1] == 5.0
    *others, fast = rates([54.0] * 4 + [5.4])
    assert fast == 5.0 > 4 * max(others)
