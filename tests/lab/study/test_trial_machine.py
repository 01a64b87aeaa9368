"""A trial as a state machine: what is written of it, and what a robot and a participant can do to it."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from share.lab.study import trial_events as te
from share.lab.study import trial_machine as tm
from share.lab.study.plan import SuccessRule
from share.lab.study.standstill import MotionWatch, RobotSample

RULE = SuccessRule(0.5, 30.0)
SPOTS = [te.CalledSpot(1, 4, (1.0, 1.0)), te.CalledSpot(2, 2, (3.0, 1.0))]
HZ = 5


class TrialBench:
    """A machine in made-up time, and a robot that is told where to be."""

    def __init__(self, goals: list[te.CalledSpot] | None = None) -> None:
        self.machine = tm.TrialMachine(SPOTS if goals is None else goals, 2, RULE)
        self.now_s = 100.0
        self.at: tuple[float, float] | None = (1.0, 4.0)
        self.effects = self.machine.begin(self.now_s)

    def do(self, event: te.TrialEvent) -> list[te.TrialEffect]:
        effects = self.machine.handle(event, self.now_s)
        self.effects += effects
        return effects

    def wait(self, seconds: float) -> None:
        """Let time go by; the robot says where it is."""
        for _ in range(round(seconds * HZ)):
            self.now_s += 1 / HZ
            sample = None if self.at is None else RobotSample(self.now_s, *self.at, 0.0)
            self.do(te.RobotPlaced(sample))
            self.do(te.TimePassed())

    def drive(self, x: float, y: float, seconds: float) -> None:
        assert self.at is not None
        began, steps = self.at, round(seconds * HZ)
        for k in range(1, steps + 1):
            self.at = began[0] + (x - began[0]) * k / steps, began[1] + (y - began[1]) * k / steps
            self.wait(1 / HZ)

    def told(self, text: str, is_final: bool = True, is_reached: bool = False) -> None:
        self.do(te.GoalReported(text, is_final, is_reached))

    def of(self, kind: type) -> list[Any]:
        return [one for one in self.effects if isinstance(one, kind)]

    def lines(self, event: str) -> list[dict[str, Any]]:
        return [dict(one.fields) for one in self.of(te.WriteLine) if one.fields["event"] == event]

    def reach(self) -> None:
        goal = self.machine.goal
        assert goal is not None
        self.do(te.CallPressed())
        self.drive(goal.place[0], goal.place[1] + 0.2, 8.0)
        self.told("reached", is_reached=True)
        self.wait(3.0)


@pytest.fixture
def bench() -> TrialBench:
    bench = TrialBench()
    bench.wait(1.2)
    return bench


def test_a_trial_from_first_spot_to_end(bench: TrialBench) -> None:
    bench.reach()
    bench.reach()
    assert bench.machine.stage is tm.TrialStage.DONE
    kinds = [one.fields["event"] for one in bench.of(te.WriteLine)]
    assert kinds == [*("call", "moves", "stands", "status"), *("call", "moves", "stands", "status"), "end"]
    assert [one.called.spot for one in bench.of(te.ShowSpot)] == [4, 2]
    call, moves, stands, status = (bench.lines(kind)[0] for kind in kinds[:4])
    assert (call["goal"], call["spot"], call["t_s"]) == (1, 4, 101.2)
    assert (call["cube_m"], call["robot_m"]) == ([1.0, 1.0], [1.0, 4.0])
    assert moves["t_s"] - call["t_s"] == pytest.approx(0.2)
    assert stands["t_s"] - call["t_s"] == pytest.approx(8.0)  # when it came to stand, not when that was sure
    assert stands["robot_m"] == [1.0, 1.2] and stands["path_m"] == pytest.approx(2.8, abs=0.03)
    assert status["status"] == "reached"
    assert [one.place for one in bench.of(te.SendRobot)] == [(1.0, 1.0), (3.0, 1.0)]


def test_a_cube_calls_where_it_lies_once_it_rests(bench: TrialBench) -> None:
    for x in (1.5, 1.4, 1.3):  # it is dragged
        bench.do(te.CubeSeen((x, 1.1)))
        bench.wait(0.2)
        assert not bench.lines("call")
    bench.wait(0.4)
    (call,) = bench.lines("call")
    assert call["cube_m"] == [1.3, 1.1] and call["by"] == "headset" and call["cube_is"] == "seen"
    assert bench.of(te.SendRobot) == [te.SendRobot((1.3, 1.1))]


def test_a_cube_in_another_map_counts_as_placed_at_the_spot(bench: TrialBench) -> None:
    bench.do(te.CubeSeen(None))
    bench.wait(0.6)
    (call,) = bench.lines("call")
    assert call["cube_m"] == [1.0, 1.0] and call["cube_is"] == "planned"


def test_a_cube_far_from_its_spot_is_said(bench: TrialBench) -> None:
    bench.do(te.CubeSeen((2.0, 1.0)))
    bench.wait(0.6)
    assert te.SayLine("the cube is 1.00 m from spot 4") in bench.effects


def test_a_second_press_calls_nothing(bench: TrialBench) -> None:
    bench.do(te.CallPressed())
    bench.do(te.CallPressed())
    bench.do(te.CubeSeen((0.0, 0.0)))
    bench.wait(2.0)
    assert len(bench.lines("call")) == 1 and len(bench.of(te.SendRobot)) == 1


def test_a_robot_whose_time_is_over_is_stopped(bench: TrialBench) -> None:
    bench.do(te.CallPressed())
    bench.drive(1.0, 2.5, 5.0)
    bench.wait(30.0 + 3.0 / 0.306 - 5.0 - 0.2)  # with the way's time at the top speed
    assert not bench.of(te.StopRobot)
    bench.wait(0.6)
    assert len(bench.of(te.StopRobot)) == 1
    bench.told("stopped: cancelled by 'study'")
    bench.wait(1.0)
    assert [one["status"] for one in bench.lines("status")] == ["timed out"]
    assert [one["robot_m"] for one in bench.lines("stands")] == [[1.0, 2.5]]
    assert bench.machine.goal == SPOTS[1]


def test_a_bridge_that_does_not_confirm_ends_no_trial(bench: TrialBench) -> None:
    bench.do(te.CallPressed())
    bench.drive(1.0, 2.0, 60.0)
    bench.wait(10.0)
    assert [one["status"] for one in bench.lines("status")] == ["timed out"]
    assert bench.machine.goal == SPOTS[1]


@pytest.mark.parametrize(
    "text",
    [
        "refused: it is in the map ann-1/0, the robot in bob-1/0",
        "stopped: the goal is in the map x, the robot now in y",
        "stopped: a correction moved the map by 0.3 m: give the goal again",
    ],
)
def test_a_goal_that_the_map_ended_is_given_again(bench: TrialBench, text: str) -> None:
    bench.do(te.CallPressed())
    bench.wait(1.0)
    bench.told(text)
    bench.wait(1.4)
    assert len(bench.of(te.SendRobot)) == 2 and len(bench.lines("call")) == 1
    bench.wait(5.0)
    assert len(bench.of(te.SendRobot)) == 2  # until that one is refused too
    bench.told(text)
    bench.wait(1.4)
    assert len(bench.of(te.SendRobot)) == 3
    for _ in range(80):
        bench.told(text)
        bench.wait(0.6)
    assert [one["status"] for one in bench.lines("status")] == [text.partition(":")[0]]
    assert len(bench.of(te.StopRobot)) == 1 and bench.machine.goal == SPOTS[1]


def test_a_robot_that_gives_up_ends_the_goal(bench: TrialBench) -> None:
    bench.do(te.CallPressed())
    bench.drive(1.0, 3.0, 4.0)
    bench.told("the robot gave up (Nav2's error 104, no valid path)")
    bench.wait(1.6)
    assert [one["status"] for one in bench.lines("status")] == ["the robot gave up"]
    assert bench.machine.goal == SPOTS[1]


def test_a_robot_that_is_there_already_stands_from_the_call_on(bench: TrialBench) -> None:
    bench.at = (1.1, 1.0)
    bench.wait(1.0)
    bench.do(te.CallPressed())
    called_s = bench.now_s
    bench.told("reached", is_reached=True)
    bench.wait(1.6)
    (stands,) = bench.lines("stands")
    assert stands["t_s"] == pytest.approx(called_s) and not bench.lines("moves")


def test_a_robot_that_is_told_to_be_there_before_it_is_seen_there(bench: TrialBench) -> None:
    bench.do(te.CallPressed())
    bench.wait(1.4)  # it is still seen where it was called
    bench.told("reached", is_reached=True)
    bench.do(te.TimePassed())
    assert not bench.lines("status")
    bench.at = (1.0, 1.2)
    bench.wait(2.0)
    assert [one["robot_m"] for one in bench.lines("stands")] == [[1.0, 1.2]]
    assert len(bench.lines("moves")) == len(bench.lines("status")) == 1


def test_a_robot_whose_place_is_unknown_is_called_all_the_same(bench: TrialBench) -> None:
    bench.at = None
    bench.wait(1.0)
    bench.do(te.CallPressed())
    (call,) = bench.lines("call")
    assert call["robot_m"] is None
    bench.wait(1.0)
    bench.at = (2.0, 2.0)
    bench.drive(1.0, 1.0, 5.0)
    bench.told("reached", is_reached=True)
    bench.wait(1.6)
    assert [one["robot_m"] for one in bench.lines("stands")] == [[1.0, 1.0]]


def test_an_interruption_stops_the_robot_and_nothing_follows(bench: TrialBench) -> None:
    bench.do(te.CallPressed())
    bench.do(te.TrialBroken("the edge\nis gone"))
    assert bench.machine.stage is tm.TrialStage.BROKEN and len(bench.of(te.StopRobot)) == 1
    (line,) = bench.lines("interrupted")
    assert line["reason"].isprintable() and "is gone" in line["reason"]
    assert bench.do(te.CallPressed()) == []


def test_what_goes_on_begins_at_the_goal_that_is_left() -> None:
    bench = TrialBench(SPOTS[1:])
    bench.wait(1.2)
    bench.reach()
    assert [one["goal"] for one in bench.lines("call")] == [2] and len(bench.lines("end")) == 1


def test_corrections_of_a_standing_robot_are_no_motion() -> None:
    watch = MotionWatch(RobotSample(0.0, 1.0, 1.0, 0.0))
    for k, off in zip(range(1, 40), itertools.cycle((0.0, 0.012, 0.02, 0.008))):
        watch.add(RobotSample(0.2 * k, 1.0 + off, 1.0, 0.0))
    assert watch.moves_s is None and watch.path_m == 0.0 and watch.stands_since() == 0.0


def test_turning_is_motion_and_no_standing() -> None:
    watch = MotionWatch(RobotSample(0.0, 1.0, 1.0, 0.0))
    for k in range(1, 20):
        watch.add(RobotSample(0.2 * k, 1.0, 1.0, 0.1 * k))
    assert watch.moves_s == pytest.approx(0.4) and watch.stands_since() is None


def test_a_gap_in_its_places_is_no_standing() -> None:
    watch = MotionWatch(RobotSample(0.0, 1.0, 1.0, 0.0))
    watch.add(RobotSample(5.0, 1.0, 1.0, 0.0))
    assert watch.stands_since() is None
    watch.add(RobotSample(5.5, 1.0, 1.0, 0.0))
    watch.add(RobotSample(6.0, 1.0, 1.0, 0.0))
    assert watch.stands_since() == 5.0


def test_an_enter_just_after_a_spot_was_shown_calls_nothing() -> None:
    bench = TrialBench()
    bench.wait(0.6)
    bench.do(te.CallPressed())
    assert not bench.lines("call") and "press it again" in bench.of(te.SayLine)[-1].text
    bench.wait(0.6)
    bench.do(te.CallPressed())
    assert len(bench.lines("call")) == 1


def leave(bench: TrialBench, seconds: float) -> None:
    """Its bridge falls silent."""
    bench.do(te.RobotGone())
    for _ in range(round(seconds * HZ)):
        bench.now_s += 1 / HZ
        bench.do(te.TimePassed())


def test_without_a_robot_nothing_is_called(bench: TrialBench) -> None:
    leave(bench, 1.0)
    bench.do(te.CallPressed())
    bench.do(te.CubeSeen((1.2, 1.0), 5))
    leave(bench, 20.0)
    assert not bench.lines("call") and not bench.of(te.SendRobot) and not bench.machine.is_over
    said = [one.text for one in bench.of(te.SayLine)]
    assert len([text for text in said if text.startswith("no robot: its bridge is silent")]) == 2
    bench.wait(0.2)  # it is back
    assert [one["cube_m"] for one in bench.lines("call")] == [[1.2, 1.0]]


def test_a_robot_that_is_gone_under_way_is_no_miss(bench: TrialBench) -> None:
    bench.do(te.CallPressed())
    bench.drive(1.0, 3.0, 3.0)
    leave(bench, 2.0)
    bench.wait(1.0)  # a short silence
    assert not bench.machine.is_over
    leave(bench, 4.0)
    assert bench.machine.stage is tm.TrialStage.BROKEN and not bench.lines("status")
    (line,) = bench.lines("interrupted")
    assert line["reason"].startswith("the robot is gone") and bench.machine.broken_reason == line["reason"]
    assert len(bench.of(te.StopRobot)) == 1
    assert not any("is stopped" in one.text for one in bench.of(te.SayLine))


def test_a_cube_that_is_removed_before_it_rests_calls_nothing(bench: TrialBench) -> None:
    bench.do(te.CubeSeen((1.0, 1.0), 5))
    bench.wait(0.2)
    bench.do(te.CubeTaken(5))
    bench.wait(2.0)
    assert not bench.lines("call")


@pytest.mark.parametrize("is_removed", [True, False])
def test_a_cube_that_moves_after_it_called_is_written_and_said_once(
    bench: TrialBench, is_removed: bool
) -> None:
    bench.do(te.CubeSeen((1.0, 1.0), 5))
    bench.wait(0.6)
    bench.do(te.CubeTaken(5) if is_removed else te.CubeSeen((1.5, 1.0), 5))
    for x in (1.7, 1.9):
        if not is_removed:
            bench.do(te.CubeSeen((x, 1.0), 5))
    bench.drive(1.0, 1.2, 5.0)
    bench.told("reached", is_reached=True)
    bench.wait(2.0)
    places = [None] if is_removed else [[1.5, 1.0], [1.9, 1.0]]
    assert [(one["goal"], one["cube_m"]) for one in bench.lines("cube moved")] == [(1, p) for p in places]
    said = [one.text for one in bench.of(te.SayLine)]
    assert len([text for text in said if "after it called" in text]) == 1
    assert bench.of(te.SendRobot) == [te.SendRobot((1.0, 1.0))]


def test_a_floor_that_moves_is_written_and_said(bench: TrialBench) -> None:
    bench.do(te.FloorMoved(0.42))
    assert [(one["goal"], one["moved_m"]) for one in bench.lines("floor moved")] == [(1, 0.42)]
    assert "the floor's marker has moved by 0.42 m" in bench.of(te.SayLine)[-1].text
    assert not bench.machine.is_over
