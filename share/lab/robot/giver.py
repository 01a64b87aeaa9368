"""Who sends the simulated robot to places: the wearer of a headset, one goal after another.

The wearer points at a place in the room; where that is in the map follows from where the headset believes to
be. So the headset's error counts as the robot's does. Until the robot shares the headset's map it is sent
about in its own, as one who sets it up would push it; these goals do not count.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from share.lab.robot.goals import GIVER, GoalOutcome
from share.lab.robot.loop import RobotLoop, transform_between
from share.robot import robot_events as ev
from share.robot.goal_control import GOAL_PREFIX
from share.robot.planar import PlanarPose
from share.types import F64

MAX_ATTEMPTS = 5  # of a goal whose map moved, or that is refused for now
_PAUSE_S = 1.0  # after an attempt, until the robot stands
_GOAL_LIMIT_S = 90.0
_REFUSAL_LIMIT_S = 30.0
_MAP_GOES_ON = ("the map", "a correction moved", "the robot now in")  # reasons to give a goal again


class Pointing(Protocol):
    """Return T_map_room, and the map's id; None while there is no map that robot and wearer share."""

    def __call__(self) -> tuple[PlanarPose, str | None] | None: ...


def points_in_room() -> tuple[PlanarPose, str | None]:
    """The map is the room: for a robot that knows its true place."""
    return PlanarPose(0.0, 0.0, 0.0), None


class HeadsetPointing:
    """The map as a headset's wearer has it. true_pose: T_room_body (4, 4) of an agent at a time."""

    def __init__(self, loop: RobotLoop, name: str, true_pose: Callable[[int], F64]) -> None:
        self._loop, self._name, self._true_pose = loop, name, true_pose

    def __call__(self) -> tuple[PlanarPose, str | None] | None:
        newest = self._loop.newest_poses.get(self._name)
        place, map_id = self._loop.place
        if newest is None or newest.T_map_odom is None or place is None or newest.map_id != map_id:
            return None
        T_map_body = newest.T_map_odom @ newest.T_odom_body
        return transform_between(T_map_body, self._true_pose(newest.arrived_ns)), map_id


class GoalGiver:
    """Gives `count` goals, one after the other's end. draw: returns the next one in the room, from where the
    robot is; pointing: by the wearer. Until they share a map: draw_first, pointing_first."""

    def __init__(
        self,
        loop: RobotLoop,
        draw: Callable[[PlanarPose], PlanarPose],
        count: int,
        pointing: Pointing,
        draw_first: Callable[[PlanarPose], PlanarPose] | None = None,
        pointing_first: Pointing | None = None,
    ) -> None:
        self.outcomes: list[GoalOutcome] = []
        self.first_goals: list[GoalOutcome] = []  # before the robot shared the map
        self.T_map_room: PlanarPose | None = None  # by the newest pointing; map_id: None for any
        self.map_id: str | None = None
        self._loop, self._draw, self._count = loop, draw, count
        self._pointing, self._draw_first, self._pointing_first = pointing, draw_first, pointing_first
        self._goal: GoalOutcome | None = None
        self._is_under_way = False
        self._next_s, self._begun_ns = 0.0, 0
        self._goal_number = 0
        loop.on_report, loop.on_trace = self._take_report, self._tick

    @property
    def is_done(self) -> bool:
        """Whether all goals have their end."""
        return self._goal is None and len(self.outcomes) >= self._count

    def _tick(self) -> None:
        now_s = self._loop.now_ns / 1e9
        pointed = self._pointing()
        if pointed is not None:
            self.T_map_room, self.map_id = pointed
        if self.is_done or now_s < self._next_s:
            return
        if self._is_under_way:
            if self._goal is not None and now_s - self._begun_ns / 1e9 > _GOAL_LIMIT_S:
                self._loop.to_bridge(ev.CancelRequested(GIVER))
            return
        if self._goal is not None and self._is_over(self._goal, now_s):
            self._finish(self._goal, now_s)
        if not self.is_done:
            self._give(pointed, now_s)

    def _is_over(self, goal: GoalOutcome, now_s: float) -> bool:
        """Return whether a goal that is not under way is not given again."""
        if goal.says_reached or goal.attempts >= MAX_ATTEMPTS:
            return True
        if goal.text.startswith("refused"):
            return now_s - goal.begun_s > _REFUSAL_LIMIT_S
        return not any(words in goal.text for words in _MAP_GOES_ON)

    def _finish(self, goal: GoalOutcome, now_s: float) -> None:
        base = self._loop.base
        goal.finish(base.at(self._loop.now_ns).T_world_base, now_s - _PAUSE_S)
        goal.path_m = base.driven_m(round(goal.begun_s * 1e9), self._loop.now_ns)
        self._goal = None

    def _give(self, pointed: tuple[PlanarPose, str | None] | None, now_s: float) -> None:
        is_first, draw = pointed is None, self._draw
        if pointed is None and self._pointing_first is not None and self._draw_first is not None:
            pointed, draw = self._pointing_first(), self._draw_first
        if pointed is None:
            return
        here = self._loop.base.at(self._loop.now_ns).T_world_base
        if self._goal is not None and is_first != (self._goal in self.first_goals):
            self._finish(self._goal, now_s)  # of the robot's own map
        if self._goal is None:
            self._goal = GoalOutcome(draw(here), begun_s=now_s)
            (self.first_goals if is_first else self.outcomes).append(self._goal)
            self._begun_ns = self._loop.now_ns
        T_map_room, map_id = pointed
        self._send(self._goal, T_map_room @ self._goal.T_world_goal, map_id)

    def _send(self, goal: GoalOutcome, in_map: PlanarPose, map_id: str | None) -> None:
        goal.in_map, goal.map_id, goal.text = in_map, map_id, ""
        self._goal_number += 1
        goal_id = GOAL_PREFIX + self._goal_number.to_bytes(16 - len(GOAL_PREFIX), "big")
        self._is_under_way = True
        goal.attempts += 1
        self._loop.to_bridge(ev.GotoRequested(GIVER, goal_id, in_map.x, in_map.y, in_map.yaw, map_id))

    def _take_report(self, report: ev.GoalReport) -> None:
        if report.commander != GIVER or self._goal is None:
            return
        if report.is_final:
            self._goal.text, self._goal.says_reached = report.text, report.is_reached
            self._is_under_way = False
            self._next_s = self._loop.now_ns / 1e9 + _PAUSE_S
            if report.text.startswith("refused"):
                self._goal.attempts -= 1
