"""Rates shared out in steps: as the plainest way of doing so, in a fraction of the time."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from helpers.stepwise_allocation import StepwiseAllocation

from share.config import ControlConfig
from share.scheduling.qoe import QoeParameters
from share.scheduling.room_budget import FREE_WAIT_MS, AgentDemand, RoomBudget
from share.types import AgentKind

AR, ROBOT = AgentKind.AR, AgentKind.ROBOT
TERMS = {kind: QoeParameters.from_config(ControlConfig(), kind) for kind in (AR, ROBOT)}
WAITS_MS = 0.75 * FREE_WAIT_MS, FREE_WAIT_MS


def random_room(rng: np.random.Generator, count: int) -> RoomBudget:
    """Return a room of agents whose keyframes take 1 to 80 ms, some without an error, some signed."""
    keyframe_ms, robots = np.exp(rng.uniform(0, np.log(80))), rng.choice([0.0, 0.3, 1.0], p=[0.2, 0.7, 0.1])
    agents = {}
    for k in range(count):
        terms = TERMS[ROBOT if rng.random() < robots else AR]
        own_ms = keyframe_ms * rng.uniform(0.5, 2.0)
        agents[f"a{k}"] = AgentDemand(
            qoe=replace(terms, signed=bool(rng.random() < 0.1)),
            wanted_hz=rng.uniform(0.1, 5.0),
            keyframe_s=own_ms / 1e3,
            arrival_s=max(0.0, own_ms * rng.uniform(0.8, 1.2) - 4) / 1e3,
            delay_ms=rng.uniform(0, 100) + own_ms,
            error_cm=None if rng.random() < 0.1 else rng.uniform(0.4, 6.0),
            drift_cm=rng.uniform(0.05, 4.0),
            hz=rng.uniform(0, 5.0),
            pose_hz=rng.uniform(2, 30),
            updated_ns=0,
            is_placed=bool(rng.random() < 0.8),
        )
    return RoomBudget(agents)


@pytest.mark.parametrize("seed", range(300))
def test_rates_are_those_of_the_plainest_way(seed: int) -> None:
    """With what they have from a moment before, when the room was a little different."""
    rng = np.random.default_rng(seed)
    budget = random_room(rng, int(rng.integers(1, 9)))
    moved = {n: replace(a, drift_cm=a.drift_cm * rng.uniform(0.5, 2)) for n, a in budget.agents.items()}
    (before,) = RoomBudget(moved).allocate((FREE_WAIT_MS,))
    plainest = StepwiseAllocation(budget, {name: grant.hz for name, grant in before.items()})
    for wait_ms, granted in zip(WAITS_MS, budget.allocate(WAITS_MS, before), strict=True):
        expected = plainest.rates(wait_ms)
        assert {name: grant.hz for name, grant in granted.items()} == pytest.approx(expected, abs=1e-9)


def test_one_wait_or_several_is_the_same() -> None:
    budget = random_room(np.random.default_rng(7), 24)
    assert budget.allocate(WAITS_MS) == [*budget.allocate(WAITS_MS[:1]), *budget.allocate(WAITS_MS[1:])]


def test_nobody_gets_nothing() -> None:
    assert RoomBudget().allocate(WAITS_MS) == [{}, {}]


def cpu_s(work: Callable[[], object]) -> float:
    """Return the least CPU time of this thread in three calls."""
    times = list[float]()
    for _ in range(3):
        began = time.thread_time()
        work()
        times.append(time.thread_time() - began)
    return min(times)


def test_it_takes_a_tenth_of_the_time_of_the_plainest_way() -> None:
    """32 agents on air that is just short, where steps are most."""
    one = AgentDemand(TERMS[AR], 5.0, 0.005, 0.001, 65.0, 1.5, 1.0, hz=1.0, pose_hz=5.0, updated_ns=0)
    room = RoomBudget({f"a{k}": replace(one, drift_cm=0.5 + k / 64) for k in range(32)})
    plainest = StepwiseAllocation(room, {})
    assert 1.0 < np.mean([grant.hz for grant in room.allocate()[0].values()]) < 5.0
    assert 10 * cpu_s(lambda: room.allocate(WAITS_MS)) < cpu_s(lambda: plainest.rates(WAITS_MS[0]))
