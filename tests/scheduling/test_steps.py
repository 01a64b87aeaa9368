"""The room after a step: rates settle, without overshoot, and come back. The same with all messages:
tools/experiments/simulate_steps.py."""

from __future__ import annotations

import pytest
from helpers.modelled_air import STEP_S, Air

from share.scheduling.room_budget import LEAST_HZ
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
    """9 ms a keyframe for 20 s twice as much: headsets yield within 8 s, and have their rates back after."""
    air = Air(9.0, ROOM)
    air.play(30)
    before = [rates[-1] for rates in headsets(air, 20, 30)]
    air.alone_ms = 18.0
    air.play(20)
    assert settled(air, 38, 50)
    assert all(min(rates) >= LEAST_HZ[AR] for rates in headsets(air, 30, 50))
    air.alone_ms = 9.0
    air.play(20)
    assert settled(air, 58, 70)
    assert [rates[-1] for rates in headsets(air, 58, 70)] == pytest.approx(before, abs=_STEP_HZ)


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
