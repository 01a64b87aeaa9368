"""Replayed agents: frames of a track in order, in laps that are segments of their own."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.hellos import hello_of

from share.earlier_poses import EarlierPoses
from share.lab.evaluate.simulation import TrackedFrame
from share.types import AgentKind, OdometryKeyframe, View

TOOLS = Path(__file__).parents[2] / "tools" / "experiments"
PERIOD_NS, COUNT = 10**8, 20
COV = np.diag([1e-6] * 6)


def candidate(k: int) -> OdometryKeyframe:
    T = np.eye(4)
    T[0, 3] = 0.1 * k
    earlier = EarlierPoses(np.array([(k - 4) * PERIOD_NS]), np.eye(4)[None], COV[None])
    return OdometryKeyframe(T, np.eye(4), COV, np.array([0.0, 0, 1]), 0.01, View.empty(), earlier=earlier)


@pytest.fixture
def replayed(monkeypatch):
    monkeypatch.syspath_prepend(TOOLS)
    made = importlib.import_module("replayed_agents")
    frames = [
        TrackedFrame(k * PERIOD_NS, np.eye(4), None, candidate(k) if k % 4 == 0 else None, 5 + k * PERIOD_NS)
        for k in range(COUNT)
    ]
    track = made.Track(AgentKind.AR, hello_of("ann", 1).rig, frames)
    return lambda index: made.ReplayedAgent([track, replace(track, kind=AgentKind.ROBOT)], index)


def test_a_long_track_is_walked_once(replayed) -> None:
    for index in range(4):
        frames = list(replayed(index).frames(1.0))
        assert [frame.new_segment for frame in frames] == [True] + [False] * (len(frames) - 1)
        assert len(frames) in (9, 10)


def test_each_lap_is_a_segment_that_begins_with_its_first_keyframe(replayed) -> None:
    agent = replayed(0)
    frames = list(agent.frames(5.0))
    assert sum(frame.new_segment for frame in frames) == 3  # 50 frames of 20
    stamps = [frame.stamp_ns for frame in frames]
    assert set(np.diff(stamps)) == {PERIOD_NS}
    begins = False
    for frame in frames:
        begins |= frame.new_segment
        if (sent := frame.candidate) is None:
            continue
        assert sent.new_segment == begins and (len(sent.earlier) == 0) == begins
        if begins:
            assert np.array_equal(sent.T_previous_body, sent.T_odom_body)
        else:
            assert sent.earlier.ids.tolist() == [frame.stamp_ns - 5 - 4 * PERIOD_NS]
        begins = False


def test_agents_differ_by_run_track_and_start(replayed) -> None:
    agents = [replayed(index) for index in range(6)]
    assert len({agent.hello.run_id for agent in agents}) == 6
    assert [agent.hello.kind for agent in agents[:2]] == [AgentKind.AR, AgentKind.ROBOT]
    assert len({next(agent.frames(0.5)).stamp_ns for agent in agents}) > 2
