"""A trial in a room that a test makes up: cubes, maps that join, a marker that goes, a full disk, no edge."""

from __future__ import annotations

import errno
import json
import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from share.errors import ShareError
from share.geometry.se3 import from_rt, so3_exp
from share.lab.study import trial_events as te
from share.lab.study import trial_machine as tm
from share.lab.study.floor import SPOT_ID, STUDY_NAME, StudyFloor
from share.lab.study.plan import SuccessRule
from share.lab.study.study_log import StudyLog
from share.lab.study.trial_runner import TrialHeader, TrialInterruptedError, TrialRunner
from share.protocol.room_events import ClientEffect, CommandChanged, ObjectChanged, RobotSeen
from share.types import F64
from share.wire.room_messages import CommandState, ObjectKind, RobotPlace, RoomObject

MAP, OTHER, MARKER = "ann-1/0", "bot-1/0", 7
SPOTS = [te.CalledSpot(1, 4, (1.0, 1.0)), te.CalledSpot(2, 2, (3.0, 1.0))]
# where the map is in the other one
T_OTHER_MAP = from_rt(so3_exp(np.array([0.0, 0.0, 1.1])), np.array([5.0, -2.0, 0.0]))


def at(x: float, y: float, yaw: float = 0.0) -> F64:
    return from_rt(so3_exp(np.array([0.0, 0.0, yaw])), np.array([x, y, 0.0]))


def thing(number: int, kind: ObjectKind, owner: str, T: F64, map_id: str = MAP) -> RoomObject:
    return RoomObject(1, 1, number, kind, owner, map_id, T)


@dataclass
class MadeUpRoom:
    """Steps of 50 ms; what it does at a step is in `plan`. The robot is at once where it is sent."""

    clock: list[float]
    objects: dict[int, RoomObject] = field(default_factory=dict)
    out: Path = Path("edge-1")
    shown: list[tuple[float, float]] = field(default_factory=list)
    sent: list[tuple[float, float]] = field(default_factory=list)
    stops: int = 0
    gone: str | None = None
    is_idle: bool = True
    knows_objects: bool = True
    robot: tuple[str, float, float] = (MAP, 4.0, 4.0)
    queue: list[ClientEffect] = field(default_factory=list)
    at_step: Callable[[int], None] = lambda step: None
    steps: int = 0

    def step(self, timeout_ms: int) -> list[ClientEffect]:
        self.clock[0] += 0.05
        self.steps += 1
        assert self.steps < 4000
        self.at_step(self.steps)
        if self.steps % 4 == 0:
            map_id, x, y = self.robot
            self.queue.append(RobotSeen(RobotPlace("bot", map_id, x, y, 0.0, "")))
        news, self.queue = self.queue, []
        return news

    def put(self, one: RoomObject) -> None:
        self.objects = self.objects | {one.object_id: one}
        self.queue.append(ObjectChanged(one))

    def remove(self, object_id: int) -> None:
        if object_id in self.objects:
            gone = replace(self.objects[object_id], removed="removed")
            self.objects = {n: one for n, one in self.objects.items() if n != object_id}
            self.queue.append(ObjectChanged(gone))

    def broken(self) -> str | None:
        return self.gone

    def report(self) -> tuple[dict[str, Any], str]:
        return {"agents": {}, "config": {"sealed_sha256": "ab"}}, ""

    def show_spot(self, floor: StudyFloor, place: tuple[float, float]) -> None:
        T = floor.in_map(*place)
        self.shown.append((round(T.x, 3), round(T.y, 3)))
        self.objects = self.objects | {
            SPOT_ID: thing(SPOT_ID, ObjectKind.MARKER, STUDY_NAME, at(T.x, T.y), floor.map_id)
        }

    def send_robot(self, floor: StudyFloor, place: tuple[float, float], robot: str | None) -> int:
        assert robot == "bot"
        T = floor.in_map(*place)
        self.sent.append((round(T.x, 3), round(T.y, 3)))
        self.robot = floor.map_id, T.x, T.y
        state = CommandState(len(self.sent), "bot", STUDY_NAME, "reached", True, True)
        self.queue.append(CommandChanged(state))
        return len(self.sent)

    def stop_robot(self) -> None:
        self.stops += 1


@dataclass
class MadeUpResearcher:
    lines: list[str] = field(default_factory=list)
    typed: list[str] = field(default_factory=list)
    wants_end: bool = False
    end_reason: str = "ended by the researcher"

    def say(self, text: str) -> None:
        self.lines.append(text)

    def poll(self) -> str | None:
        return self.typed.pop(0) if self.typed else None

    def forget_typed(self) -> None:
        self.typed.clear()


@dataclass
class RunnerBench:
    folder: Path
    clock: list[float] = field(default_factory=lambda: [50.0])

    def __post_init__(self) -> None:
        self.room = MadeUpRoom(self.clock, {MARKER: thing(MARKER, ObjectKind.MARKER, "lead", at(0.0, 0.0))})
        self.researcher = MadeUpResearcher()
        self.log = StudyLog(self.folder / "events.jsonl")
        machine = tm.TrialMachine(SPOTS, 2, SuccessRule())
        self.runner = TrialRunner(self.room, self.log, self.researcher, machine)  # type: ignore[arg-type]

    def run(self) -> None:
        self.runner.run(TrialHeader({"participant": "p01"}, 20.0), [])

    def events(self, kind: str) -> list[dict[str, Any]]:
        rows = [json.loads(line) for line in self.log.path.read_text().splitlines()]
        return [row for row in rows if row["event"] == kind]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RunnerBench]:
    bench = RunnerBench(tmp_path)
    monkeypatch.setattr(time, "monotonic", lambda: bench.clock[0])
    yield bench
    bench.log.close()


def test_cubes_call_and_are_taken_away(bench: RunnerBench) -> None:
    old = thing(30, ObjectKind.CUBE, "ann", at(0.2, 0.2))  # of before the trial: calls nothing
    bench.room.objects |= {30: old}

    def place(step: int) -> None:
        if step in (20, 120):
            x = 1.0 if step == 20 else 3.0
            bench.room.put(thing(step, ObjectKind.CUBE, "ann", at(x, 1.1)))

    bench.room.at_step = place
    bench.run()
    assert bench.room.sent == [(1.0, 1.1), (3.0, 1.1)] and bench.room.shown == [(1.0, 1.0), (3.0, 1.0)]
    assert set(bench.room.objects) == {MARKER, 30}
    calls = bench.events("call")
    assert [one["cube_m"] for one in calls] == [[1.0, 1.1], [3.0, 1.1]] and len(bench.events("end")) == 1
    assert all(one["t_s"] > 20.0 for one in calls)  # the clock goes on where the trial was
    assert bench.events("begin")[0]["config_sha256"] == "ab"


@pytest.mark.parametrize("marker_first", [True, False])
def test_a_map_that_joins_another_moves_nothing_on_the_floor(bench: RunnerBench, marker_first: bool) -> None:
    """A cube that goes with its map calls nothing; places in the file stay in the floor's frame."""
    cube = thing(31, ObjectKind.CUBE, "ann", at(2.5, 2.5))
    bench.room.objects |= {31: cube}
    order = [bench.room.objects[MARKER], cube]

    def join(step: int) -> None:
        if step == 30:
            for one in order if marker_first else order[::-1]:
                bench.room.put(replace(one, map_id=OTHER, T_map_object=T_OTHER_MAP @ one.T_map_object))
            T = T_OTHER_MAP @ at(4.0, 4.0)
            bench.room.robot = OTHER, float(T[0, 3]), float(T[1, 3])
        if step in (60, 200):
            bench.researcher.typed.append("")

    bench.room.at_step = join
    bench.run()
    calls = bench.events("call")
    assert [one["by"] for one in calls] == ["terminal", "terminal"]
    np.testing.assert_allclose(calls[0]["robot_m"], [4.0, 4.0], atol=1e-3)
    assert calls[0]["cube_m"] == [1.0, 1.0]
    goal = T_OTHER_MAP @ at(1.0, 1.0)
    np.testing.assert_allclose(bench.room.sent[0], goal[:2, 3], atol=1e-3)
    np.testing.assert_allclose(bench.events("stands")[0]["robot_m"], [1.0, 1.0], atol=1e-3)
    np.testing.assert_allclose(bench.room.shown[1], goal[:2, 3], atol=1e-3)  # shown anew in the other map


def test_a_marker_that_goes_and_comes_again(bench: RunnerBench) -> None:
    def change(step: int) -> None:
        if step == 10:
            bench.room.remove(MARKER)
        if step == 40:
            bench.researcher.typed.append("")
        if step == 100:
            bench.room.put(thing(99, ObjectKind.MARKER, "lead", at(1.0, 0.0)))
        if step == 400:
            bench.researcher.typed.append("")

    bench.room.at_step = change
    bench.run()
    assert "the floor's marker was removed; place it again" in bench.researcher.lines
    assert bench.room.sent[0] == (2.0, 1.0)  # by the new one, called again once it was there
    assert bench.events("call")[0]["robot_m"] is None


def test_an_edge_that_is_gone_ends_the_trial_with_its_reason(bench: RunnerBench) -> None:
    def end(step: int) -> None:
        if step == 30:
            bench.room.gone = "the edge ended (exit code 1): out of luck"

    bench.room.at_step = end
    with pytest.raises(TrialInterruptedError, match="out of luck"):
        bench.run()
    (line,) = bench.events("interrupted")
    assert "out of luck" in line["reason"] and not bench.events("end")


def test_the_researcher_ends_the_trial_and_the_robot_stops(bench: RunnerBench) -> None:
    def end(step: int) -> None:
        bench.researcher.wants_end = step >= 30
        if step == 25:
            bench.researcher.typed.append("")
            bench.room.send_robot = lambda *goal: 5  # type: ignore[method-assign]

    bench.room.at_step = end
    with pytest.raises(TrialInterruptedError, match="ended by the researcher"):
        bench.run()
    assert bench.room.stops == 1 and SPOT_ID not in bench.room.objects


def test_a_full_disk_stops_the_robot_and_loses_nothing(
    bench: RunnerBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def press(step: int) -> None:
        if step == 25:
            bench.researcher.typed.append("")
        if step == 30:
            monkeypatch.setattr(os, "write", full)

    def full(handle: int, data: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    bench.room.at_step = press
    with pytest.raises(ShareError, match=r"events\.jsonl: cannot be written: No space left on device"):
        bench.run()
    assert bench.room.stops == 1 and SPOT_ID not in bench.room.objects
    assert [len(bench.events(kind)) for kind in ("begin", "call")] == [1, 1]


def test_a_silent_bridge_is_no_standing_robot(bench: RunnerBench) -> None:
    def silence(step: int) -> None:
        if step == 20:
            bench.room.robot = OTHER, 0.0, 0.0  # in a map that the floor is not in
        if step == 40:
            bench.researcher.typed.append("")
        if step > 40 and bench.room.sent:
            bench.room.robot = OTHER, 0.0, 0.0
            bench.researcher.wants_end = step > 400

    bench.room.at_step = silence
    with pytest.raises(TrialInterruptedError):
        bench.run()
    assert bench.events("call")[0]["robot_m"] is None and not bench.events("stands")
    assert math.isclose(bench.events("status")[0]["t_s"] - bench.events("call")[0]["t_s"], 5.05, abs_tol=0.3)


def test_the_checks_come_before_the_trial_and_enter_begins_it(bench: RunnerBench) -> None:
    """`report` has no agent, so not all is well; that is overruled by two presses, and kept."""

    def press(step: int) -> None:
        if step in (60, 80):
            bench.researcher.typed.append("")

    bench.room.at_step = press
    unwell = bench.runner.wait_until_ready()
    assert unwell == ["agents", "clocks", "poses", "map", "robot"] and bench.room.steps == 80
    assert "not well: agents, clocks, poses, map, robot; Enter again begins all the same" in (
        bench.researcher.lines
    )
    assert len([line for line in bench.researcher.lines if line.startswith("WAIT  agents")]) == 1  # once


def test_no_trial_begins_without_its_floor(bench: RunnerBench) -> None:
    bench.room.objects = {}

    def press(step: int) -> None:
        bench.researcher.typed.append("")
        bench.researcher.wants_end = step > 100

    bench.room.at_step = press
    with pytest.raises(TrialInterruptedError, match="before it began"):
        bench.runner.wait_until_ready()
    assert "no spot can be shown without the floor's one marker; see above" in bench.researcher.lines
    assert not bench.log.path.exists()


def test_only_enter_alone_calls(bench: RunnerBench) -> None:
    def press(step: int) -> None:
        if step in (40, 200):
            bench.researcher.typed += ["help", "go on"]
            assert len(bench.room.sent) == (step == 200)
        if step in (60, 220):
            bench.researcher.typed.append(" ")

    bench.room.at_step = press
    bench.run()
    calls = bench.events("call")
    assert len(calls) == 2 and calls[0]["t_s"] == pytest.approx(23.0, abs=0.1)
    assert (
        bench.researcher.lines.count("Enter alone calls the robot, q and Enter ends; 'help' does nothing")
        == 2
    )


def test_a_marker_that_somebody_moves_is_told(bench: RunnerBench) -> None:
    def move(step: int) -> None:
        if step in (30, 31):  # the second time by less than the noise
            bench.room.put(thing(MARKER, ObjectKind.MARKER, "lead", at(0.3 + 0.001 * step, 0.0)))
        if step in (60, 200):
            bench.researcher.typed.append("")

    bench.room.at_step = move
    bench.run()
    assert [one["moved_m"] for one in bench.events("floor moved")] == [0.33]


def test_a_bridge_that_dies_under_way_interrupts_the_trial(bench: RunnerBench) -> None:
    def die(step: int) -> None:
        if step == 40:
            bench.room.send_robot = lambda *goal: 5  # type: ignore[method-assign]
            bench.researcher.typed.append("")
        if step > 60:
            bench.room.steps -= step % 4 == 3  # never its turn
            bench.researcher.wants_end = bench.clock[0] > 90.0

    bench.room.at_step = die
    with pytest.raises(TrialInterruptedError, match="the robot is gone: its bridge is silent"):
        bench.run()
    assert len(bench.events("call")) == 1 and not bench.events("status")
