"""A simulated participant: presses by the clock, and presses again where the robot does not come.

It writes down what happens as `share study run` does with people: `calls`, first motion, each place where the
robot stands, by the simulation's truth. A cube lies where the participant sees its spot, so the error of its
own headset counts as the robot's does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from share.lab.robot.loop import transform_between
from share.lab.robot.planner import Costmap
from share.lab.study.simulated_loop import StudyLoop
from share.lab.study.simulated_room import PlannedCall
from share.lab.study.standstill import BY_TRUTH, MotionWatch, RobotSample
from share.robot import robot_events as ev
from share.robot.goal_control import GOAL_PREFIX
from share.robot.planar import PlanarPose
from share.types import F64

_AGAIN_S = 1.0  # after it hears that the robot does not come
_UNANSWERED_S = 5.0  # after a press of which it hears nothing
_STANDS_S = 3.0  # before the first call
_TICK_S = 0.1
_STATUSES = ("reached", "succeeded"), ("the robot gave up", "aborted"), ("refused", "refused")

Event = dict[str, Any]
DrawGoal = Callable[[PlanarPose], PlanarPose]


class SimulatedParticipant:
    """Presses at each of `calls`, in the room; the robot is driven about by `draw` before, until both share
    a map.

    true_pose: T_room_body (4, 4) of its headset at a session time. events: what happened, in order of
    writing. presses: how often it pressed. shared_s: when it first was in the robot's map, NaN if never.
    place_errors_m: of the robot in the participant's map, once a second.
    """

    def __init__(
        self,
        loop: StudyLoop,
        name: str,
        true_pose: Callable[[int], F64],
        calls: Sequence[PlannedCall],
        end_s: float,
        draw: DrawGoal,
    ) -> None:
        self.events: list[Event] = []
        self.presses = 0
        self.shared_s = math.nan
        self.place_errors_m: list[float] = []
        self._loop, self._name, self._true_pose = loop, name, true_pose
        self._calls, self._end_s, self._draw = list(calls), end_s, draw
        self._number = 0  # of the goal under way, from 1; 0 before the first
        self._goal_id, self._is_under_way, self._is_over = b"", False, False
        self._next_press_s = 0.0
        self._cube_in_map: tuple[PlanarPose, str | None] | None = None
        self._status = "none"
        self._began_ns = 0
        self._watch = MotionWatch(None, BY_TRUTH)
        self._has_moved = False
        self._stood = False  # and that is written down
        self._ticks = 0
        loop.on_report, loop.on_trace = self._pass_report_on, self._tick

    # ------------------------------------------------------------ each tenth of a second

    def _tick(self) -> None:
        now_s = self._loop.now_ns / 1e9
        here = self._loop.base.at(self._loop.now_ns).T_world_base
        self._ticks += 1
        if self._ticks % round(1 / _TICK_S) == 0:
            self._compare_maps(now_s, here)
        if self._number == 0:
            self._set_up(now_s, here)
        else:
            self._watch_robot(now_s, here)
        next_s = self._calls[self._number].t_s if self._number < len(self._calls) else self._end_s
        if now_s >= next_s:
            self._go_on(now_s, here)
        elif self._number and not self._is_over and now_s >= self._next_press_s:
            self._press(self._calls[self._number - 1])

    def _go_on(self, now_s: float, here: PlanarPose) -> None:
        """End the goal under way, and call the next, or end the trial."""
        if self.events and self.events[-1]["event"] == "end":
            return
        if self._number:
            self._write(now_s, "status", goal=self._number, status=self._status)
        if self._number < len(self._calls):
            self._number += 1
            self._call(now_s, here)
        else:
            self._write(now_s, "end")

    def _set_up(self, now_s: float, here: PlanarPose) -> None:
        """Drive the robot about in its own map, as one who sets it up would push it, but for the last
        seconds."""
        place, map_id = self._loop.place
        if now_s > self._calls[0].t_s - _STANDS_S:
            if self._is_under_way:
                self._loop.to_bridge(ev.CancelRequested(self._name))
            return
        if now_s < self._next_press_s or math.isfinite(self.shared_s) or place is None:
            return
        goal = place @ here.inverse() @ self._draw(here)
        self._loop.to_bridge(self._request(goal, map_id))

    def _watch_robot(self, now_s: float, here: PlanarPose) -> None:
        """Write down the first motion, and where the robot stands."""
        self._watch.add(_sample(now_s, here))
        if self._watch.moves_s is not None and not self._has_moved:
            self._has_moved = True
            self._write(now_s, "moves", goal=self._number)
        since_s = self._watch.stands_since()
        counts = since_s is not None and (self._has_moved or self._is_over)
        if since_s is not None and counts and not self._stood:
            self._write_stop(since_s, here)
        self._stood = counts

    def _write_stop(self, t_s: float, here: PlanarPose) -> None:
        place, map_id = self._loop.place
        cube = self._cube_in_map
        by_map_m = None
        if place is not None and cube is not None and cube[1] == map_id:
            by_map_m = round(place.distance_m(cube[0]), 4)
        path_m = self._loop.base.driven_m(self._began_ns, self._loop.now_ns)
        where = {"robot_m": _xy(here), "path_m": round(path_m, 4), "by_map_m": by_map_m}
        self._write(t_s, "stands", goal=self._number, **where)

    def _compare_maps(self, now_s: float, here: PlanarPose) -> None:
        pointed, (place, map_id) = self._map_of_headset(), self._loop.place
        if pointed is not None and place is not None and pointed[1] == map_id:
            self.shared_s = now_s if math.isnan(self.shared_s) else self.shared_s
            self.place_errors_m.append(place.distance_m(pointed[0] @ here))

    # ------------------------------------------------------------ calls

    def _call(self, now_s: float, here: PlanarPose) -> None:
        call = self._calls[self._number - 1]
        self._began_ns, self._watch = self._loop.now_ns, MotionWatch(_sample(now_s, here), BY_TRUTH)
        self._has_moved = self._stood = self._is_over = self._is_under_way = False
        self._status, self._cube_in_map = "none", None
        cube = {"spot": call.spot, "cube_m": [round(call.x, 4), round(call.y, 4)]}
        path_m = round(self._way_m(here, call), 4)
        self._write(now_s, "call", goal=self._number, **cube, robot_m=_xy(here), path_m=path_m)
        self._press(call)

    def _way_m(self, here: PlanarPose, call: PlannedCall) -> float:
        """Return the way to the cube, straight where there is no other."""
        grid, cube = self._loop.grid, PlanarPose(call.x, call.y, call.yaw)
        way = Costmap(grid, here.inverse(), np.zeros((0, 2))).plan(here, cube)
        straight_m = here.distance_m(cube)
        return straight_m if way is None else max(straight_m, _length_m(way))

    def _press(self, call: PlannedCall) -> None:
        """Send the robot to where the cube is in the headset's map, if that has one."""
        pointed = self._map_of_headset()
        if pointed is None:
            self._status, self._next_press_s = "no map", self._loop.now_ns / 1e9 + _AGAIN_S
            return
        self.presses += 1
        T_map_room, map_id = pointed
        cube = T_map_room @ PlanarPose(call.x, call.y, call.yaw)
        self._cube_in_map = cube, map_id
        request = self._request(cube, map_id)
        self._loop.command(self._name, request)

    def _request(self, goal: PlanarPose, map_id: str | None) -> ev.GotoRequested:
        self._is_under_way = True
        self._next_press_s = self._loop.now_ns / 1e9 + _UNANSWERED_S
        number = int.from_bytes(self._goal_id[len(GOAL_PREFIX) :], "big") + 1 if self._goal_id else 1
        self._goal_id = GOAL_PREFIX + number.to_bytes(16 - len(GOAL_PREFIX), "big")
        return ev.GotoRequested(self._name, self._goal_id, goal.x, goal.y, goal.yaw, map_id)

    def _map_of_headset(self) -> tuple[PlanarPose, str | None] | None:
        newest = self._loop.newest_poses.get(self._name)
        if newest is None or newest.T_map_odom is None:
            return None
        T_map_body = newest.T_map_odom @ newest.T_odom_body
        return transform_between(T_map_body, self._true_pose(newest.arrived_ns)), newest.map_id

    # ------------------------------------------------------------ reports

    def _pass_report_on(self, report: ev.GoalReport) -> None:
        if self._number == 0:
            self._hear(report)  # of the drive before the first call
        elif not report.text.endswith("to go"):
            self._loop.answer(self._name, report, lambda: self._hear(report))

    def _hear(self, report: ev.GoalReport) -> None:
        if report.goal_id != self._goal_id:
            return  # of an earlier press
        self._status = _status_of(report)
        self._next_press_s = math.inf  # it is on its way
        if report.is_final:
            self._is_under_way = False
            self._is_over = report.is_reached and self._number > 0
            self._next_press_s = self._loop.now_ns / 1e9 + _AGAIN_S

    def _write(self, t_s: float, event: str, **fields: Any) -> None:
        self.events.append({"t_s": round(t_s, 3), "event": event, **fields})


def _sample(t_s: float, pose: PlanarPose) -> RobotSample:
    return RobotSample(t_s, pose.x, pose.y, pose.yaw)


def _status_of(report: ev.GoalReport) -> str:
    """Return the navigator's status, or the bridge's answer, in a word."""
    for beginning, status in _STATUSES:
        if report.text.startswith(beginning):
            return status
    return "canceled" if report.is_final else "executing"


def _xy(pose: PlanarPose) -> list[float]:
    return [round(pose.x, 4), round(pose.y, 4)]


def _length_m(way: F64) -> float:
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
