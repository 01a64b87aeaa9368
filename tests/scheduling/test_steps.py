"""The room after a step: rates settle, without overshoot, and come back. The same with all messages:
tools/experiments/simulate_steps.py."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.modelled_air import STEP_S, Air

from share.scheduling.room_budget import MIN_HZ, SMALL_SIZE
from share.types import AgentKind

AR, ROBOT = AgentKind.AR, AgentKind.ROBOT
ROOM = (AR, AR, ROBOT) * 4
_STEP_HZ = 0.25


def headsets(air: Air, since_s: float, until_s: float) -> list[list[float]]:
    """Return each headset's rates from a time to another."""
    begin, end = round(since_s / STEP_S), round(until_s / STEP_S)
    rows = [row[: len(ROOM)] for row in air.history[begin:end]]
    return [list(rates) for kind, rates in zip(ROOM, zip(*rows, strict=True), strict=True) if kind is AR]


def settled(air: Air, since_s: float, until_s: float) -> bool:
    """Whether no headset's rate moves by more than one step."""
    return all(max(rates) - min(rates) <= _STEP_HZ for rates in headsets(air, since_s, until_s))


def test_half_the_air() -> None:
    """9 ms a keyframe with a small picture, for 30 s twice as much: headsets yield within 17 s, are back
    after 8."""
    air = Air(9.0 / SMALL_SIZE, ROOM)
    air.play(30)
    before = [rates[-1] for rates in headsets(air, 20, 30)]
    air.alone_ms *= 2
    air.play(30)
    assert settled(air, 47, 60)
    assert all(rates[-1] <= 1 for rates in headsets(air, 30, 60))
    assert all(min(rates) >= MIN_HZ[AR] for rates in headsets(air, 30, 60))
    air.alone_ms /= 2
    air.play(20)
    assert settled(air, 68, 80)
    assert [rates[-1] for rates in headsets(air, 68, 80)] == pytest.approx(before, abs=_STEP_HZ)


def test_as_many_again_arrive_at_once() -> None:
    air = Air(18.0, ROOM)
    air.play(30)
    air.join(ROOM)
    air.play(30)
    assert settled(air, 40, 60)
    assert max(air.history[-1]) <= 1.5 and air.load() < 0.6


def test_a_pause_of_the_edge() -> None:
    """5 s without a word, then all that waited: after 12 s everyone has what it had."""
    air = Air(9.0, ROOM)
    air.play(30)
    before = air.history[-1]
    air.pause(5.0)
    assert air.room.objection(AR, round(35e9)) is None  # nor is anyone turned away
    air.play(25)
    assert settled(air, 42, 55)  # of what was recorded: from 12 to 25 s after the pause
    assert air.history[-1] == pytest.approx(before, abs=_STEP_HZ)


@pytest.mark.long
@pytest.mark.parametrize("alone_ms", [9.0, 12.0, 15.0, 18.0, 34.0])
def test_what_each_measures_is_noisy_and_rates_stand_all_the_same(alone_ms: float) -> None:
    """Keyframes take 25 % more or less, robots want 5 Hz: where the air is just short rates do not swing."""
    air = Air(alone_ms, ROOM, robots_hz=5.0, noise=0.25)
    air.play(80)
    moves = [np.diff(rates) for rates in zip(*air.history[40:], strict=True)]
    assert np.mean([np.count_nonzero(move) for move in moves]) <= 3
    before, after = (np.mean(air.history[at][2::3]) for at in (-60, -1))
    assert after == pytest.approx(before, abs=1.0)


def test_robots_yield_before_headsets_where_the_air_is_just_short() -> None:
    air = Air(12.0 / SMALL_SIZE, ROOM, robots_hz=5.0, noise=0.25)
    air.play(60)
    for kind, hz in zip(ROOM, air.history[-1], strict=True):
        assert hz == 1.5 if kind is AR else hz < 3


def test_a_rate_that_was_cut_rises_step_by_step() -> None:
    air = Air(34.0, ROOM, robots_hz=5.0)
    air.play(30)
    air.alone_ms = 3.0
    air.play(30)
    assert air.history[-1] == [1.5 if kind is AR else 5.0 for kind in ROOM]
    assert np.diff(air.history[58:], axis=0).max() <= _STEP_HZ + 1e-9
