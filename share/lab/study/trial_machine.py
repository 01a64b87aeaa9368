"""A trial as a state machine: spot after spot is shown, called, driven to, and written down.

`TrialMachine.handle` takes an event and the time and returns effects; it knows no clock, socket or file.
Places are in the floor's frame (`share.lab.study.floor`), m; times are seconds of the trial's clock.

A call is the moment when the robot is sent: Enter at the researcher's terminal, or CUBE_RESTS_S after the
participant has let go of the cube. A cube or a press while the robot is under way calls nothing. Without a
robot nothing is called; one that is gone under way breaks the trial off, so that its goal is no miss.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum, auto
from typing import Any

from share.errors import printable
from share.lab.study.plan import SuccessRule
from share.lab.study.standstill import MotionWatch, RobotSample
from share.lab.study.trial_events import (
    CalledSpot,
    CallPressed,
    CubeSeen,
    CubeTaken,
    FloorMoved,
    GoalReported,
    Place,
    RobotGone,
    RobotPlaced,
    SayLine,
    SendRobot,
    ShowSpot,
    StopRobot,
    TimePassed,
    TrialBroken,
    TrialEffect,
    TrialEvent,
    WriteLine,
)
from share.robot.settings import CREATE3_SPEED_M_S

CUBE_RESTS_S = 0.5
PRESS_AFTER_S = 1.0  # a spot was shown: an earlier press was meant for something else
GONE_UNDER_WAY_S = 3.0  # after its bridge has fallen silent
SEND_AGAIN_S = 1.0  # after a refusal, or where the robot's map moved
_STOPS_WITHIN_S = 5.0  # after a goal's end, or its time-out: then the next spot is shown anyway
_SEEN_AFTER_S = 0.3  # the end of a goal, the robot is seen to stand
_MAX_STATUS_LENGTH = 100
_MAP_GOES_ON = ("the map", "a correction moved", "the robot now in")  # reasons to send the robot again


class TrialStage(Enum):
    """What the trial waits for."""

    CALL = auto()
    ROBOT = auto()  # under way
    STANDSTILL = auto()  # its goal has ended
    DONE = auto()
    BROKEN = auto()


class TrialMachine:
    """One trial from its first goal that is left. `begin` returns the first effects."""

    def __init__(self, goals: Sequence[CalledSpot], total: int, rule: SuccessRule) -> None:
        self._goals, self._total, self._rule = list(goals), total, rule
        self.stage = TrialStage.CALL
        self._robot: RobotSample | None = None
        self._gone_since_s: float | None = None  # of the robot
        self._cube: tuple[float, CubeSeen] | None = None  # when it moved last
        self.broken_reason = ""
        self._effects: list[TrialEffect] = []
        self._now_s = self._shown_s = 0.0
        self._forget_goal()

    def _forget_goal(self) -> None:
        self._watch = MotionWatch(None)
        self._called_s = self._limit_s = self._ended_s = 0.0
        self._target: Place = (0.0, 0.0)
        self._send_again_s: float | None = None
        self._status = ""
        self._has_written_motion = False
        self._written_stand_s: float | None = None
        self._is_standing = self._is_late = self._has_said_again = self._has_said_gone = False
        self._called_cube: int | None = None
        self._cube_written: CubeSeen | CubeTaken | None = None  # since the call: it moved
        self._cube_now: CubeSeen | CubeTaken | None = None

    @property
    def goal(self) -> CalledSpot | None:
        """What is shown or called; None after the last."""
        return self._goals[0] if self._goals else None

    @property
    def is_over(self) -> bool:
        return self.stage in (TrialStage.DONE, TrialStage.BROKEN)

    def begin(self, now_s: float) -> list[TrialEffect]:
        self._effects, self._now_s = [], now_s
        self._show_next()
        return self._effects

    def handle(self, event: TrialEvent, now_s: float) -> list[TrialEffect]:
        """Return the effects of an event. now_s: never falls."""
        if self.is_over:
            return []
        self._effects, self._now_s = [], now_s
        match event:
            case RobotPlaced():
                self._gone_since_s = None
                self._on_robot(event.sample)
            case RobotGone():
                self._gone_since_s = now_s
                self._robot = None
            case CubeSeen():
                self._on_cube(event)
            case CubeTaken():
                self._on_cube_taken(event)
            case FloorMoved():
                self._on_floor_moved(event.moved_m)
            case CallPressed():
                self._on_press()
            case GoalReported():
                self._on_goal_report(event)
            case TrialBroken():
                self._on_broken(event.reason)
            case TimePassed():
                pass
        self._do_due()
        return self._effects

    # ------------------------------------------------------------ events

    def _on_robot(self, sample: RobotSample | None) -> None:
        self._robot = sample
        if sample is None or self.stage is TrialStage.CALL:
            return
        self._watch.add(sample)
        if self._watch.moves_s is not None and not self._has_written_motion:
            self._has_written_motion = True
            self._write("moves", self._watch.moves_s)
        since_s = self._watch.stands_since()
        if self._has_written_motion and since_s is not None and not self._is_standing:
            self._write_stand(max(since_s, self._called_s))
            self._written_stand_s = since_s
        self._is_standing = since_s is not None

    def _on_cube(self, seen: CubeSeen) -> None:
        if self.stage is TrialStage.CALL:
            self._cube = self._now_s, seen
        elif seen.number == self._called_cube:
            self._on_called_cube(seen)
        else:
            self._say("the robot is under way: this cube calls nothing")

    def _on_cube_taken(self, taken: CubeTaken) -> None:
        if self.stage is not TrialStage.CALL:
            if taken.number == self._called_cube:
                self._on_called_cube(taken)
        elif self._cube is not None and self._cube[1].number == taken.number:
            self._cube = None
            self._say("the cube was removed before it called")

    def _on_called_cube(self, event: CubeSeen | CubeTaken) -> None:
        """Note that the cube that called has moved: the robot goes on to where it lay."""
        self._cube_now = event
        if self._cube_written is None:
            self._write_cube()
            what = "removed" if isinstance(event, CubeTaken) else "moved"
            self._say(f"the cube was {what} after it called; the robot drives to where it lay then")

    def _write_cube(self) -> None:
        self._cube_written = now = self._cube_now
        place = now.place if isinstance(now, CubeSeen) else None
        self._write("cube moved", self._now_s, cube_m=None if place is None else _rounded(place))

    def _on_floor_moved(self, moved_m: float | None) -> None:
        self._write("floor moved", self._now_s, moved_m=None if moved_m is None else round(moved_m, 4))
        if moved_m is None:
            self._say("the floor's marker was removed; place it again")
        else:
            self._say(
                f"the floor's marker has moved by {moved_m:.2f} m, and all places with it: if somebody moved "
                "it, put it back, or end by q"
            )

    def _on_press(self) -> None:
        if self.stage is not TrialStage.CALL:
            self._say("the robot is under way: Enter calls nothing")
        elif self._now_s - self._shown_s < PRESS_AFTER_S:
            self._say("the spot was shown just now: this Enter calls nothing; press it again")
        elif self._gone_since_s is not None:
            self._say("no robot: its bridge is silent; look there. Nothing is called")
        else:
            self._call(None, "terminal")

    def _on_goal_report(self, report: GoalReported) -> None:
        if self.stage is not TrialStage.ROBOT or not report.is_final:
            return
        text = printable(report.text)
        is_to_repeat = text.startswith("refused") or any(words in text for words in _MAP_GOES_ON)
        if not report.is_reached and is_to_repeat and not self._is_late:
            if not self._has_said_again:
                self._has_said_again = True
                self._say(f"{text}; it is called again until its time is over")
            self._send_again_s = self._now_s + SEND_AGAIN_S
            self._status = _word(text)
            return
        self._end_goal("reached" if report.is_reached else "timed out" if self._is_late else _word(text))
        if not report.is_reached and not self._is_late:
            self._say(text)

    def _on_broken(self, reason: str) -> None:
        self.broken_reason = reason
        if self.stage in (TrialStage.ROBOT, TrialStage.STANDSTILL):
            self._effects.append(StopRobot())
        self._effects.append(
            WriteLine({"event": "interrupted", "t_s": round(self._now_s, 3), "reason": printable(reason)})
        )
        self.stage = TrialStage.BROKEN

    def _do_due(self) -> None:
        """Do what the time brings."""
        now_s, gone_s = self._now_s, self._gone_since_s
        is_under_way = self.stage in (TrialStage.ROBOT, TrialStage.STANDSTILL)
        if self.stage is TrialStage.CALL and self._cube is not None:
            moved_s, seen = self._cube
            if now_s - moved_s >= CUBE_RESTS_S:
                self._call_by_cube(seen)
        elif is_under_way and gone_s is not None and now_s - gone_s >= GONE_UNDER_WAY_S:
            self._on_broken("the robot is gone: its bridge is silent; look at the robot, it may still drive")
        elif self.stage is TrialStage.ROBOT:
            if now_s > self._limit_s and not self._is_late:
                self._on_time_out()
            elif self._is_late and now_s - self._ended_s > _STOPS_WITHIN_S:
                self._end_goal("timed out")
                self._say("the robot's bridge does not confirm that it stops; look at the robot")
            elif self._send_again_s is not None and now_s >= self._send_again_s:
                self._send_again_s = None
                self._effects.append(SendRobot(self._target))
        elif self.stage is TrialStage.STANDSTILL:
            stands = self._watch.stands_since() is not None and self._is_seen_since_end
            if stands or now_s - self._ended_s > _STOPS_WITHIN_S:
                self._finish_goal(stands)

    @property
    def _is_seen_since_end(self) -> bool:
        """Whether the newest place is later than the goal's end, as it comes by another way than that."""
        newest = self._watch.newest
        return newest is not None and newest.t_s >= self._ended_s + _SEEN_AFTER_S

    def _on_time_out(self) -> None:
        self._is_late, self._ended_s = True, self._now_s
        self._effects.append(StopRobot())
        self._say("its time is over; the robot is told to stop")
        if self._send_again_s is not None:  # it has no goal now
            self._end_goal(self._status)

    # ------------------------------------------------------------ a goal

    def _show_next(self) -> None:
        self._forget_goal()
        self._cube, self._shown_s = None, self._now_s
        self.stage = TrialStage.CALL
        goal = self.goal
        if goal is None:
            self.stage = TrialStage.DONE
            self._effects.append(WriteLine({"event": "end", "t_s": round(self._now_s, 3)}))
            return
        self._effects.append(ShowSpot(goal))
        where = f"x {goal.place[0]:.2f} y {goal.place[1]:.2f} m"
        self._say(f"{goal.number} of {self._total}: spot {goal.spot}, {where}; the cube, or Enter, calls")

    def _call_by_cube(self, seen: CubeSeen) -> None:
        if self._gone_since_s is None:
            self._called_cube = seen.number
            self._call(seen.place, "headset")
        elif not self._has_said_gone:
            self._has_said_gone = True
            self._say("no robot: its bridge is silent; look there. The cube calls once it is back")

    def _call(self, cube: Place | None, by: str) -> None:
        goal = self._goals[0]
        self._cube, self.stage, self._called_s = None, TrialStage.ROBOT, self._now_s
        self._target = goal.place if cube is None else cube
        robot = self._robot
        self._watch = MotionWatch(
            None if robot is None else RobotSample(self._now_s, robot.x, robot.y, robot.yaw)
        )
        place = None if robot is None else (robot.x, robot.y)
        way_m = 0.0 if place is None else math.dist(place, self._target)
        self._limit_s = self._now_s + self._rule.timeout_s + way_m / CREATE3_SPEED_M_S
        self._write(
            "call",
            self._now_s,
            spot=goal.spot,
            cube_m=_rounded(self._target),
            robot_m=None if place is None else _rounded(place),
            by=by,
            cube_is="seen" if cube is not None else "planned",
        )
        off_m = math.dist(self._target, goal.place)
        if off_m > self._rule.distance_m:
            self._say(f"the cube is {off_m:.2f} m from spot {goal.spot}")
        self._effects.append(SendRobot(self._target))

    def _end_goal(self, status: str) -> None:
        """The robot has given its goal up, or is there: what is left is that it stands."""
        self._status, self._send_again_s, self._ended_s = status, None, self._now_s
        self.stage = TrialStage.STANDSTILL

    def _finish_goal(self, stands: bool) -> None:
        since_s, newest = self._watch.stands_since(), self._watch.newest
        if stands and since_s is not None and self._written_stand_s is None:  # it never began to move
            self._write_stand(max(since_s, self._called_s))
        if self._cube_now is not self._cube_written:
            self._write_cube()  # where it lies now
        took_s = (self._written_stand_s or self._now_s) - self._called_s
        self._write("status", self._now_s, status=self._status)
        where = ""
        if newest is not None:
            where = f", {math.dist((newest.x, newest.y), self._target):.2f} m from the cube"
        self._say(f"{self._status} after {took_s:.1f} s{where}")
        del self._goals[0]
        self._show_next()

    def _write_stand(self, t_s: float) -> None:
        newest = self._watch.newest
        assert newest is not None
        path_m = round(self._watch.path_m, 3)
        self._write("stands", t_s, robot_m=_rounded((newest.x, newest.y)), path_m=path_m)

    def _write(self, event: str, t_s: float, **fields: Any) -> None:
        line = {"event": event, "t_s": round(t_s, 3), "goal": self._goals[0].number, **fields}
        self._effects.append(WriteLine(line))

    def _say(self, text: str) -> None:
        self._effects.append(SayLine(text))


def _word(text: str) -> str:
    """Return what a bridge says of a goal without its particulars, so that statuses can be counted."""
    return text.partition(":")[0].partition(",")[0].partition(" (")[0][:_MAX_STATUS_LENGTH] or "unknown"


def _rounded(place: Place) -> list[float]:
    return [round(value, 4) for value in place]
