"""A navigator as Nav2's, as a state machine: goals and transforms in, cmd_vel out.

Plans anew each second, follows the path by regulated pure pursuit (Macenski et al., *Regulated Pure Pursuit
for Robot Path Tracking*, Autonomous Robots 47, 2023), turns in place first where the path begins aside, and
last to the goal's yaw. Tolerances and time-outs are the defaults of Nav2 and the TurtleBot 4's parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from share.lab.robot.planner import Costmap
from share.robot.planar import PlanarPose, wrapped
from share.robot.robot_events import GoalStatus
from share.robot.settings import CREATE3_SPEED_M_S
from share.timing import SECOND_NS, PeriodicTimer, seconds_to_ns
from share.types import F64

GOAL_TOLERANCE_M, GOAL_TOLERANCE_RAD = 0.25, 0.25
CONTROL_S = 0.05  # controller_frequency: 20 Hz
_TF_TOLERANCE_S = 0.2  # transform_tolerance: a transform that ended longer ago is too old
_FAILURE_S = 0.3  # failure_tolerance: the controller bears so long that it cannot control
_REPLAN_S = 1.0
_PLAN_PATIENCE_S = 10.0  # a blocked way is waited for (the recoveries of Nav2's behaviour tree)
_PROGRESS_M, _PROGRESS_S = 0.5, 10.0  # progress checker; a turn counts as well
_PROGRESS_RAD = 0.5
_LOOKAHEAD_M = 0.5
_ASIDE_RAD = 0.785  # rotate_to_heading_min_angle
_TURN_RAD_S, _TURN_GAIN = 1.0, 2.0
_APPROACH_M, _MIN_SPEED_M_S = 0.6, 0.05  # approach_velocity_scaling_dist, min_approach_linear_velocity
_BEND_RADIUS_M = 0.6  # tighter bends are driven more slowly
ABORTED_TF, ABORTED_PLAN, ABORTED_PROGRESS = 102, 203, 105  # Nav2's codes: TF_ERROR, NO_VALID_PATH, …


@dataclass(frozen=True)
class CmdVel:
    """A command to the base."""

    speed_m_s: float
    turn_rad_s: float


STOP = CmdVel(0.0, 0.0)


class Navigator:
    """One robot's navigation. `tick` each CONTROL_S gives the command; None while no goal is under way.

    Times: the robot's clock, ns. T_map_base: None where the transform is missing or too old.
    """

    def __init__(self) -> None:
        self.statuses: dict[bytes, GoalStatus] = {}
        self.abort_code = 0
        self._task: tuple[bytes, PlanarPose] | None = None
        self._T_map_odom: PlanarPose | None = None
        self._valid_until_ns = 0
        self._T_odom_base: PlanarPose | None = None
        self._costmap: Costmap | None = None
        self._path: F64 | None = None
        self._plan_timer = PeriodicTimer(_REPLAN_S)
        self._max_speed_m_s = CREATE3_SPEED_M_S
        self._place_lost_ns: int | None = None
        self._path_lost_ns: int | None = None
        self._is_there = False  # within the tolerance once: only the yaw is left (stateful goal checker)
        self._progress: tuple[int, PlanarPose] | None = None

    # ------------------------------------------------------------ in

    def take_map_odom(self, stamp_ns: int, T_map_odom: PlanarPose) -> None:
        """Take `map → odom`, valid until a stamp."""
        self._valid_until_ns, self._T_map_odom = stamp_ns, T_map_odom

    def take_odometry(self, T_odom_base: PlanarPose) -> None:
        self._T_odom_base = T_odom_base

    def take_costmap(self, costmap: Costmap) -> None:
        self._costmap = costmap

    def limit_speed(self, speed_m_s: float) -> None:
        self._max_speed_m_s = min(speed_m_s, CREATE3_SPEED_M_S)

    def take_goal(self, goal_id: bytes, goal: PlanarPose) -> None:
        """Begin a goal; one under way is preempted by it."""
        if self._task is not None:
            self._end(GoalStatus.ABORTED)
        self.statuses[goal_id] = GoalStatus.EXECUTING
        self._task, self._path, self._is_there = (goal_id, goal), None, False
        self._place_lost_ns = self._path_lost_ns = self._progress = None
        self._plan_timer = PeriodicTimer(_REPLAN_S)

    def cancel(self, goal_id: bytes) -> None:
        """Give this goal up, if it is under way."""
        if self._task is not None and self._task[0] == goal_id:
            self._end(GoalStatus.CANCELED)

    # ------------------------------------------------------------ out

    @property
    def distance_m(self) -> float | None:
        """The way left to the goal under way, straight; None without one."""
        if self._task is None or self._T_map_odom is None or self._T_odom_base is None:
            return None
        return (self._T_map_odom @ self._T_odom_base).distance_m(self._task[1])

    def has_place(self, now_ns: int) -> bool:
        """Whether `map → odom` is there and valid at a time."""
        return self._place(now_ns) is not None

    def tick(self, now_ns: int) -> CmdVel | None:
        """Return the command at a time; None where nothing is to be commanded."""
        if self._task is None:
            return None
        T_map_base = self._place(now_ns)
        if T_map_base is None:
            return self._wait_for_place(now_ns)
        self._place_lost_ns = None
        goal = self._task[1]
        self._is_there = self._is_there or T_map_base.distance_m(goal) <= GOAL_TOLERANCE_M
        if self._is_there:
            return self._turn_to_goal(wrapped(goal.yaw - T_map_base.yaw))
        if not self._makes_progress(T_map_base, now_ns):
            return self._abort(ABORTED_PROGRESS)
        if self._plan_timer.fire_if_due(now_ns) and self._costmap is not None:
            self._path = self._costmap.plan(T_map_base, goal)
        if self._path is None:
            return self._wait_for_path(now_ns)
        self._path_lost_ns = None
        return self._follow(self._path, T_map_base)

    def _place(self, now_ns: int) -> PlanarPose | None:
        if self._T_map_odom is None or self._T_odom_base is None:
            return None
        if now_ns > self._valid_until_ns + seconds_to_ns(_TF_TOLERANCE_S):
            return None
        return self._T_map_odom @ self._T_odom_base

    def _wait_for_place(self, now_ns: int) -> CmdVel:
        self._place_lost_ns = now_ns if self._place_lost_ns is None else self._place_lost_ns
        is_over = now_ns - self._place_lost_ns >= seconds_to_ns(_FAILURE_S)
        return self._abort(ABORTED_TF) if is_over else STOP

    def _wait_for_path(self, now_ns: int) -> CmdVel:
        self._path_lost_ns = now_ns if self._path_lost_ns is None else self._path_lost_ns
        self._progress = None
        is_over = now_ns - self._path_lost_ns >= seconds_to_ns(_PLAN_PATIENCE_S)
        return self._abort(ABORTED_PLAN) if is_over else STOP

    def _makes_progress(self, T_map_base: PlanarPose, now_ns: int) -> bool:
        if self._progress is not None:
            since_ns, before = self._progress
            is_near = before.distance_m(T_map_base) < _PROGRESS_M
            if is_near and abs(wrapped(T_map_base.yaw - before.yaw)) < _PROGRESS_RAD:
                return now_ns - since_ns < _PROGRESS_S * SECOND_NS
        self._progress = now_ns, T_map_base
        return True

    def _turn_to_goal(self, left_rad: float) -> CmdVel:
        if abs(left_rad) <= GOAL_TOLERANCE_RAD:
            self._end(GoalStatus.SUCCEEDED)
            return STOP
        return CmdVel(0.0, _turn_speed(left_rad))

    def _follow(self, path: F64, T_map_base: PlanarPose) -> CmdVel:
        here = np.array([T_map_base.x, T_map_base.y])
        carrot = T_map_base.inverse() @ PlanarPose(*_carrot(path, here), 0.0)
        bearing = math.atan2(carrot.y, carrot.x)
        if abs(bearing) > _ASIDE_RAD:
            return CmdVel(0.0, _turn_speed(bearing))
        distance_m = max(math.hypot(carrot.x, carrot.y), 1e-3)
        curvature = 2 * carrot.y / distance_m**2
        left_m = float(np.linalg.norm(path[-1] - here))
        speed = self._max_speed_m_s * min(1.0, 1 / max(abs(curvature) * _BEND_RADIUS_M, 1e-9))
        speed = max(speed * min(1.0, left_m / _APPROACH_M), _MIN_SPEED_M_S)
        return CmdVel(speed, max(-_TURN_RAD_S, min(_TURN_RAD_S, speed * curvature)))

    def _abort(self, code: int) -> CmdVel:
        self.abort_code = code
        self._end(GoalStatus.ABORTED)
        return STOP

    def _end(self, status: GoalStatus) -> None:
        assert self._task is not None
        self.statuses[self._task[0]] = status
        self._task = None


def _turn_speed(left_rad: float) -> float:
    """Return the rate, rad/s, of a turn in place by an angle."""
    return math.copysign(min(_TURN_RAD_S, max(0.2, _TURN_GAIN * abs(left_rad))), left_rad)


def _carrot(path: F64, here: F64) -> tuple[float, float]:
    """Return the point of a path that is _LOOKAHEAD_M on from the place nearest to the robot."""
    nearest = int(np.argmin(np.linalg.norm(path - here, axis=1)))
    rest = path[nearest:]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rest, axis=0), axis=1))])
    x, y = (float(np.interp(_LOOKAHEAD_M, along, rest[:, k])) for k in (0, 1))
    return x, y
