"""The robot bridge as a state machine: poses and odometry in, `map → odom` and goals out.

The robot moves only by an allowed goal, in the map in which it was given, while its pose there is known. When
one of these conditions ends, the robot stops, and a line says which.
"""

from __future__ import annotations

import math
from typing import Any

from share.errors import printable
from share.protocol.common_events import PrintLine, Tick
from share.robot import robot_events as ev
from share.robot.goal_control import ActiveGoal, GoalControl
from share.robot.map_odom import MapJumped, MapOdom
from share.robot.planar import PlanarPose
from share.robot.settings import RobotSettings
from share.timing import LineLimiter, PeriodicTimer, seconds_to_ns

LEAD_S = 0.3  # map → odom is valid so far ahead: tf2 does not extrapolate
PUBLISH_S = 0.02
_TOO_FAST_S = 0.5
_SPEED_MARGIN = 1.25  # of the limit: a controller overshoots
_SPEED_LIMIT_S = 1.0  # the limit is repeated so often while a goal is under way
_MAX_NAME_LENGTH = 64


class RobotBridge:
    """One robot. `handle` takes an event and the host's monotonic time, and returns effects."""

    def __init__(self, settings: RobotSettings) -> None:
        self._settings = settings
        self._place = MapOdom(settings)
        self._goals = GoalControl()
        self._robot: ev.RobotDiscovered | None = None
        self._area_map = None if settings.area is None else settings.area.map_id
        self._publish_timer, self._speed_timer = PeriodicTimer(PUBLISH_S), PeriodicTimer(_SPEED_LIMIT_S)
        self._stamp_ns = 0  # of the last map → odom
        self._published: PlanarPose | None = None
        self._edge_lost_ns: int | None = None
        self._too_fast_ns: int | None = None
        self._fault: str | None = ""  # last line printed; "" at the start
        self._line_limiter = LineLimiter()
        self._effects: list[ev.RobotEffect] = []
        self._now_ns = 0

    def handle(self, event: ev.RobotEvent, now_ns: int) -> list[ev.RobotEffect]:
        """Return the effects of `event` at `now_ns`, ns, which never decreases."""
        self._effects, self._now_ns = [], now_ns
        match event:
            case ev.AgentPoseReceived():
                self._on_pose(event)
            case ev.OdometryReceived():
                self._on_map_jumped(self._place.add_odometry(event, now_ns))
                self._check_speed(event.speed_m_s)
            case ev.ForeignMapFrame():
                self._place.add_foreign(printable(event.frame)[:_MAX_NAME_LENGTH], now_ns)
            case ev.RobotDiscovered():
                self._on_discovered(event)
            case ev.GotoRequested():
                self._on_goto(event)
            case ev.CancelRequested():
                self._stop(f"cancelled by {event.commander}")
                self._effects += self._goals.take_cancel(event)
            case ev.CommanderLost():
                goal = self._goals.active
                if goal is not None and goal.commander == event.commander:
                    self._stop(f"the link to {event.commander} is gone")
            case ev.StatusReceived():
                self._effects += self._goals.take_status(event, now_ns)
            case ev.FeedbackReceived():
                self._effects += self._goals.take_feedback(event)
            case ev.GoalAnswered():
                self._goals.take_answer(event, now_ns)
            case ev.ResultReceived():
                self._effects += self._goals.take_result(event)
            case Tick():
                pass
        self._check_place()
        self._effects += self._goals.tick(now_ns)
        return self._effects

    @property
    def has_goal(self) -> bool:
        """Whether a goal is under way, or being stopped."""
        return self._goals.active is not None

    def report(self, now_ns: int) -> dict[str, Any]:
        """Return where the robot is and what it does, as plain data. Pose: x, y in m, yaw in rad."""
        self._now_ns = now_ns
        place, goal, T = self._place, self._goals.active, self._place.T_map_base
        fault = self._present_fault()
        return {
            "pose": None if T is None or fault is not None else [round(v, 4) for v in (T.x, T.y, T.yaw)],
            "map_id": place.map_id,
            "fault": fault,
            "refusal": self._refusal(),
            "goal": None
            if goal is None
            else {
                "commander": goal.commander,
                "x": goal.T_map_base.x,
                "y": goal.T_map_base.y,
                "yaw": goal.T_map_base.yaw,
                "map_id": goal.map_id,
                "status": str(goal.status),
            },
            "release": "" if self._robot is None else self._robot.release,
        }

    # ------------------------------------------------------------ the robot's place

    def _on_pose(self, pose: ev.AgentPoseReceived) -> None:
        self._on_map_jumped(self._place.add_pose(pose, self._now_ns))
        if self._area_map is None:
            self._area_map = self._place.map_id
        if pose.has_edge is not False:
            self._edge_lost_ns = None
        elif self._edge_lost_ns is None:
            self._edge_lost_ns = self._now_ns

    def _on_map_jumped(self, jumped: MapJumped | None) -> None:
        if jumped is not None:
            self._print(jumped.text)
            self._stop(f"{jumped.text}: give the goal again")

    def _check_place(self) -> None:
        """Publish where the robot is; or stop it, once, where that is not known any more."""
        fault = self._present_fault()
        if fault != self._fault:
            self._fault = fault
            self._print(
                f"map → odom is published, map {self._place.map_id}"
                if fault is None
                else f"no map → odom: {fault}"
            )
        if fault is not None:
            self._stop(fault)
        elif (reason := self._stop_reason()) is not None:
            self._stop(reason)
        is_new = self._place.T_map_odom is not self._published
        if fault is None and (is_new or self._publish_timer.fire_if_due(self._now_ns)):
            self._publish()
        if self._goals.active is not None and self._speed_timer.fire_if_due(self._now_ns):
            self._effects.append(ev.LimitSpeed(self._settings.max_speed_m_s))

    def _present_fault(self) -> str | None:
        if self._robot is not None and self._robot.odometry_publishers > 1:
            return f"{self._robot.odometry_publishers} robots publish this odometry; give each its namespace"
        return self._place.fault(self._now_ns)

    def _publish(self) -> None:
        robot_ns, T_map_odom = self._place.robot_ns(self._now_ns), self._place.T_map_odom
        assert robot_ns is not None and T_map_odom is not None
        # rising: the estimate of the robot's clock may step back by a millisecond
        self._stamp_ns = max(self._stamp_ns + 1, robot_ns + seconds_to_ns(LEAD_S))
        self._published = T_map_odom
        self._publish_timer.postpone(self._now_ns + seconds_to_ns(PUBLISH_S))
        self._effects.append(ev.PublishMapOdom(self._stamp_ns, T_map_odom))

    def _stop_reason(self) -> str | None:
        """Return why a goal under way has to stop, though the robot's place is known."""
        goal, T_map_base = self._goals.active, self._place.T_map_base
        if goal is None or T_map_base is None:
            return None
        if goal.map_id != self._place.map_id:
            return f"the goal is in the map {goal.map_id}, the robot now in {self._place.map_id}"
        return self._robot_refusal() or self._edge_refusal() or self._area_refusal(T_map_base, "the robot")

    def _check_speed(self, speed_m_s: float) -> None:
        is_too_fast = abs(speed_m_s) > _SPEED_MARGIN * self._settings.max_speed_m_s
        if self._goals.active is None or not is_too_fast:
            self._too_fast_ns = None
        elif self._too_fast_ns is None:
            self._too_fast_ns = self._now_ns
        elif self._now_ns - self._too_fast_ns > seconds_to_ns(_TOO_FAST_S):
            limit = self._settings.max_speed_m_s
            self._stop(
                f"it drives at {abs(speed_m_s):.2f} m/s, {limit:g} are allowed; set Nav2's own limit too"
            )

    # ------------------------------------------------------------ goals

    def _on_goto(self, event: ev.GotoRequested) -> None:
        refusal = self._refusal() or self._goal_refusal(event)
        if refusal is not None:
            self._print(f"goal of {event.commander} refused: {refusal}")
            text = f"refused: {refusal}"
            self._effects.append(ev.GoalReport(event.commander, text, is_final=True, goal_id=event.goal_id))
            return
        robot_ns, here, map_id = (
            self._place.robot_ns(self._now_ns),
            self._place.T_map_base,
            self._place.map_id,
        )
        assert robot_ns is not None and here is not None and map_id is not None
        yaw = math.atan2(event.y - here.y, event.x - here.x) if event.yaw is None else event.yaw
        pose = PlanarPose(event.x, event.y, yaw)
        goal = ActiveGoal(event.commander, event.goal_id, map_id, pose, self._now_ns)
        self._speed_timer.postpone(self._now_ns + seconds_to_ns(_SPEED_LIMIT_S))
        self._print(f"{event.commander} sends the robot to x {pose.x:.2f} y {pose.y:.2f} m in {map_id}")
        self._effects.append(ev.LimitSpeed(self._settings.max_speed_m_s))
        self._effects += self._goals.begin(goal, robot_ns)

    def _refusal(self) -> str | None:
        """Return why no goal at all is taken at present."""
        here = self._place.T_map_base
        if not self._settings.allow_goals:
            return "goals are not allowed; start the bridge with --allow-goals once the robot's way is clear"
        if (refusal := self._robot_refusal()) is not None:
            return refusal
        if (fault := self._present_fault()) is not None or here is None:
            return fault or "the robot's place is not known"
        if self._goals.is_driven_by_others:
            return "another program has sent the robot a goal; let that end, or cancel it there"
        return self._edge_refusal() or self._area_refusal(here, "the robot")

    def _goal_refusal(self, event: ev.GotoRequested) -> str | None:
        """Return why this goal is not taken."""
        active = self._goals.active
        values = (event.x, event.y, 0.0 if event.yaw is None else event.yaw)
        if not all(math.isfinite(value) and abs(value) < 1e5 for value in values):
            return "x, y or yaw is not finite or too large"
        if event.map_id is not None and event.map_id != self._place.map_id:
            return f"it is in the map {printable(event.map_id)[:100]}, the robot in {self._place.map_id}"
        if active is not None and active.commander != event.commander:
            return f"{active.commander} is sending the robot; cancel that first"
        return self._area_refusal(PlanarPose(*values), "the goal")

    def _robot_refusal(self) -> str | None:
        robot = self._robot
        if robot is None:
            return "still looking for the robot"
        if not robot.has_participants:
            return (
                "there is nothing on this domain; give the robot's --domain, or --peer ADDRESS where the "
                "network has no multicast; a robot with a discovery server is invisible: "
                "set it to simple discovery"
            )
        if robot.servers == 0:
            others = " or ".join(f"--namespace {one}" for one in robot.others)
            hint = f"there is one with {others}" if others else "is Nav2 running?"
            return f"no robot answers navigate_to_pose here; {hint}"
        if robot.servers > 1:
            return f"{robot.servers} robots answer navigate_to_pose here; give each its namespace"
        if not robot.is_fast_dds:
            return "the robot's Nav2 does not use Fast DDS; set RMW_IMPLEMENTATION=rmw_fastrtps_cpp there"
        return None

    def _edge_refusal(self) -> str | None:
        silence_s = self._settings.edge_silence_s
        if self._edge_lost_ns is None or self._now_ns - self._edge_lost_ns <= seconds_to_ns(silence_s):
            return None
        return f"the agent has received nothing from its edge for {silence_s:g} s"

    def _area_refusal(self, pose: PlanarPose, what: str) -> str | None:
        area = self._settings.area
        if area is None:
            return None
        if self._area_map != self._place.map_id:
            return f"the area is in the map {self._area_map}, the robot in {self._place.map_id}; draw it anew"
        return (
            None if area.contains(pose) else f"{what} (x {pose.x:.2f} y {pose.y:.2f} m) is outside the area"
        )

    def _stop(self, reason: str) -> None:
        effects = self._goals.stop(reason, self._now_ns)
        if effects:
            self._print(f"the robot is stopped: {reason}")
        self._effects += effects

    # ------------------------------------------------------------ the robot on its network

    def _on_discovered(self, robot: ev.RobotDiscovered) -> None:
        before, self._robot = self._robot, robot
        if before == robot:
            return
        refusal = self._robot_refusal()
        release = f" ({robot.release})" if robot.release else ""
        self._print(f"found the robot's navigation{release}" if refusal is None else refusal)

    def _print(self, text: str) -> None:
        if (line := self._line_limiter.admit(text, self._now_ns)) is not None:
            self._effects.append(PrintLine(line))
