"""A simulated room with a robot in the loop: what its camera sees decides where it drives.

Times are session time, ns, which is the simulation's. The robot's clock shows START_NS more, as its device's
does and as a real one's would show the time of day.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from share.config import Config
from share.geometry.se3 import from_rt, inverse, so3_exp
from share.lab.emulate.types import START_NS
from share.lab.evaluate.emulated_network import NetworkModel
from share.lab.evaluate.processing_delays import ProcessingDelays
from share.lab.evaluate.simulation import TrackedFrame
from share.lab.robot.base import RobotBase, is_person_ahead
from share.lab.robot.breakable import BreakableRoom
from share.lab.robot.navigator import CONTROL_S, STOP, CmdVel, Navigator
from share.lab.robot.planner import Costmap, RoomGrid
from share.protocol import agent_events as aev
from share.protocol.common_events import PrintLine, Tick
from share.robot import robot_events as ev
from share.robot.bridge import RobotBridge
from share.robot.planar import PlanarPose, flattened
from share.robot.pose_message import parse_pose_message
from share.robot.settings import RobotSettings
from share.runtime.pose import localised_pose
from share.runtime.pose_feed import PoseMessages
from share.timing import seconds_to_ns
from share.types import F64, TrackState
from share.wire.messages import Hello

ROBOT = "robot"
_MS = 1_000_000
_DDS_NS, _LOCAL_NS = 3 * _MS, 1 * _MS  # a message between two programs on the robot's network; on one machine
_ODOMETRY_NS = 50 * _MS  # a Create 3 sends 20 a second
_TICK_NS = 20 * _MS  # of the bridge
_COSTMAP_NS = 500 * _MS
_TRACE_NS = 100 * _MS
_FEEDBACK_TICKS = 20  # of control
_POSE_AGE_NS = 30 * _MS  # of perfect poses and those of wheels: as old as a tracker's

Member = tuple[Hello, Iterator[TrackedFrame], NetworkModel]
PeopleAt = Callable[[int], F64]  # places (P, 2) of people at a session time


class RobotAgent(Protocol):
    """The robot's agent. frame_times_ns: of its camera's frames; frame: what its tracker makes of one."""

    @property
    def hello(self) -> Hello: ...

    @property
    def frame_times_ns(self) -> Sequence[int]: ...

    def frame(self, number: int) -> TrackedFrame: ...

    def restart(self, now_ns: int) -> None:
        """Begin another run, at a session time."""
        ...

    def show_bare_wall(self, is_shown: bool) -> None: ...


class RobotLoop(BreakableRoom):
    """The robot, its navigation, its bridge, and the room's agents and edge.

    agent: the robot's; None where `own_pose` says where it is instead, T_map_base at each of frame_times_ns.
    on_report, on_trace: called with each report to a commander, and ten times a second.
    trace: time s, true place, place by the map or None, map. lines: time s, text. newest_poses: of each
    agent.
    """

    def __init__(
        self,
        config: Config,
        members: Sequence[Member],
        seed: int,
        base: RobotBase,
        grid: RoomGrid,
        people_at: PeopleAt,
        settings: RobotSettings,
        agent: RobotAgent | None,
        network: NetworkModel,
        own_pose: Callable[[int], PlanarPose] | None = None,
        frame_times_ns: Sequence[int] = (),
        delays: ProcessingDelays | None = None,
    ) -> None:
        own = [] if agent is None else [(agent.hello, iter(()), network)]
        costs = ProcessingDelays() if delays is None else delays
        super().__init__(config, [*members, *own], costs, seed, on_effect=self._take_agent_effect)
        self.base, self.navigator, self.lines = base, Navigator(), list[tuple[float, str]]()
        self.trace: list[tuple[float, PlanarPose, PlanarPose | None, str | None]] = []
        self.newest_poses: dict[str, aev.LocalisedPose] = {}
        self.nearest_person_m = np.inf
        self.on_report: Callable[[ev.GoalReport], None] = lambda report: None
        self.on_trace: Callable[[], None] = lambda: None
        self._grid, self._people_at, self._settings = grid, people_at, settings
        self._own_pose, self._agent, self._network, self._seed = own_pose, agent, network, seed
        self._T_base_body = inverse(settings.T_body_base)
        self._messages = PoseMessages(ROBOT)
        self._statuses: tuple[tuple[bytes, ev.GoalStatus], ...] = ()
        self._control_count = 0
        self.bridge: RobotBridge | None = None
        self.start_bridge()
        for action in (self._send_odometry, self._control, self._bridge_tick, self._look, self._write_trace):
            self.schedule(0, action)
        for number, time_ns in enumerate(agent.frame_times_ns if agent else frame_times_ns):
            self.schedule(time_ns, lambda number=number: self._take_frame(number))  # type: ignore[misc]

    def note(self, text: str) -> None:
        """Keep a line, with its time."""
        self.lines.append((self.now_ns / 1e9, text))

    # ------------------------------------------------------------ the robot

    def _send_odometry(self) -> None:
        step, made_ns = self.base.at(self.now_ns), self.now_ns + START_NS
        self.schedule(_DDS_NS, lambda: self.navigator.take_odometry(step.T_odom_base))
        self.schedule(
            _DDS_NS,
            lambda: self.to_bridge(
                ev.OdometryReceived(
                    made_ns, self.now_ns + START_NS, step.T_odom_base, abs(step.odom_speed_m_s)
                )
            ),
        )
        self.schedule(_ODOMETRY_NS, self._send_odometry)

    def _look(self) -> None:
        """Give the navigator what a lidar sees."""
        T_world_base = self.base.at(self.now_ns).T_world_base
        self.navigator.take_costmap(Costmap(self._grid, T_world_base.inverse(), self._people_at(self.now_ns)))
        self.schedule(_COSTMAP_NS, self._look)

    def _control(self) -> None:
        command = self.navigator.tick(self.now_ns)
        people, here = self._people_at(self.now_ns), self.base.at(self.now_ns).T_world_base
        if len(people):
            distances = np.linalg.norm(people - (here.x, here.y), axis=1)
            self.nearest_person_m = min(self.nearest_person_m, float(distances.min()))
        if command is not None:
            if command.speed_m_s > 0 and is_person_ahead(here, people):
                command = CmdVel(STOP.speed_m_s, command.turn_rad_s)
            self.base.command(self.now_ns, command.speed_m_s, command.turn_rad_s)
        self._publish_status()
        self.schedule(seconds_to_ns(CONTROL_S), self._control)

    def _publish_status(self) -> None:
        statuses = tuple(self.navigator.statuses.items())
        if statuses != self._statuses:
            self._statuses = statuses
            self.schedule(_DDS_NS, lambda: self.to_bridge(ev.StatusReceived(statuses)))
        self._control_count += 1
        distance_m = self.navigator.distance_m
        if distance_m is not None and statuses and self._control_count % _FEEDBACK_TICKS == 0:
            feedback = ev.FeedbackReceived(statuses[-1][0], distance_m)
            self.schedule(_DDS_NS, lambda: self.to_bridge(feedback))

    def _write_trace(self) -> None:
        report = None if self.bridge is None else self.bridge.report(self.now_ns)
        pose = None if report is None or report["pose"] is None else PlanarPose(*report["pose"])
        map_id = None if report is None else report["map_id"]
        self.trace.append((self.now_ns / 1e9, self.base.at(self.now_ns).T_world_base, pose, map_id))
        self.on_trace()
        self.schedule(_TRACE_NS, self._write_trace)

    # ------------------------------------------------------------ the robot's agent

    def _take_frame(self, number: int) -> None:
        self.base.advance(self.now_ns)
        if self._own_pose is not None:
            self._send_own_pose(self._own_pose(self.now_ns))
        elif self._agent is not None and self.has_run(ROBOT):
            self._frame_arrived(self.run_of(ROBOT), self._agent.frame(number))

    def kill_robot_agent(self) -> None:
        if self._agent is not None:
            self.kill_agent(ROBOT)

    def start_robot_agent(self) -> None:
        if self._agent is not None:
            self._agent.restart(self.now_ns)
            self._messages = PoseMessages(ROBOT)
            self.start_agent(self._agent.hello, self._network, self._seed)

    def show_bare_wall(self, is_shown: bool) -> None:
        """Let the robot's cameras see nothing but a bare wall, or the room again."""
        if self._agent is not None:
            self._agent.show_bare_wall(is_shown)

    def _send_own_pose(self, T_map_base: PlanarPose) -> None:
        T_map_body = solid_pose(T_map_base) @ self._T_base_body
        sequence = round(self.now_ns / _MS)
        event = ev.AgentPoseReceived(
            ROBOT, sequence, TrackState.OK, T_map_body, "own", 1e-3, _POSE_AGE_NS, None
        )
        self.schedule(_POSE_AGE_NS, lambda: self.to_bridge(event))

    def _take_agent_effect(self, name: str, effect: aev.AgentEffect) -> None:
        if isinstance(effect, aev.LocalisedPose):
            self.newest_poses[name] = effect
        if name != ROBOT:
            return
        match effect:
            case aev.LocalisedPose():
                age_ms = (self.now_ns - effect.arrived_ns) / _MS
                self._send_message(self._messages.of_pose(localised_pose(effect, age_ms, self._hears_edge)))
            case aev.FrameDone() if not effect.state.has_pose:
                self._send_message(self._messages.of_state(effect.stamp_ns, effect.state))
            case aev.StatusReport() if effect.is_stale and effect.stamp_ns is not None:
                status = effect.status
                self._send_message(self._messages.of_state(effect.stamp_ns, status.state, status.pose_age_ms))
            case PrintLine():
                self.note(f"agent: {effect.text}")

    @property
    def _hears_edge(self) -> bool:
        return self.has_run(ROBOT) and self.run_of(ROBOT).machine.is_connected

    def _send_message(self, text: str) -> None:
        pose = parse_pose_message(text.encode())
        aged = replace(pose, age_ns=(pose.age_ns or 0) + _LOCAL_NS)
        self.schedule(_LOCAL_NS, lambda: self.to_bridge(aged))

    # ------------------------------------------------------------ the bridge

    def start_bridge(self) -> None:
        """Start a bridge; it finds the robot and what status its navigation has latched."""
        self.bridge = RobotBridge(self._settings)
        self.schedule(_DDS_NS, lambda: self.to_bridge(ev.RobotDiscovered(1, 1, release="jazzy")))
        self.schedule(_DDS_NS, lambda: self.to_bridge(ev.StatusReceived(self._statuses)))

    def kill_bridge(self) -> None:
        """End the bridge at once, and with it the commands that wait for it."""
        goal = None if self.bridge is None else self.bridge.report(self.now_ns)["goal"]
        self.bridge = None
        if goal is not None:
            self.on_report(ev.GoalReport(goal["commander"], "the bridge has ended", is_final=True))

    def _bridge_tick(self) -> None:
        self.to_bridge(Tick())
        self.schedule(_TICK_NS, self._bridge_tick)

    def to_bridge(self, event: ev.RobotEvent) -> None:
        """Let the bridge handle an event, if there is one, and carry its effects out."""
        if self.bridge is None:
            return
        for effect in self.bridge.handle(event, self.now_ns):
            self._carry_out(effect)

    def _carry_out(self, effect: ev.RobotEffect) -> None:
        navigator = self.navigator
        match effect:
            case ev.PublishMapOdom():
                until_ns, T = effect.stamp_ns - START_NS, effect.T_map_odom
                self.schedule(_DDS_NS, lambda: navigator.take_map_odom(until_ns, T))
            case ev.SendGoal():
                goal_id, goal = effect.goal_id, effect.T_map_base
                self.schedule(_DDS_NS, lambda: navigator.take_goal(goal_id, goal))
            case ev.CancelGoal():
                cancelled = effect.goal_id
                self.schedule(_DDS_NS, lambda: navigator.cancel(cancelled))
            case ev.AskResult():
                self.schedule(2 * _DDS_NS, lambda: self.to_bridge(ev.ResultReceived(navigator.abort_code)))
            case ev.LimitSpeed():
                navigator.limit_speed(effect.speed_m_s)
            case ev.GoalReport():
                if not effect.text.endswith("to go"):
                    self.note(f"{effect.commander}: {effect.text}")
                self.on_report(effect)
            case PrintLine():
                self.note(effect.text)

    @property
    def place(self) -> tuple[PlanarPose | None, str | None]:
        """Where the robot believes to be, and in which map."""
        if self.bridge is None:
            return None, None
        report = self.bridge.report(self.now_ns)
        return None if report["pose"] is None else PlanarPose(*report["pose"]), report["map_id"]


def solid_pose(T: PlanarPose) -> F64:
    """Return a pose on the floor as (4, 4)."""
    return from_rt(so3_exp(np.array([0.0, 0.0, T.yaw])), np.array([T.x, T.y, 0.0]))


def transform_between(T_a_body: F64, T_b_body: F64) -> PlanarPose:
    """Return T_a_b on the floor, of one body's poses (4, 4) in both."""
    return flattened(T_a_body @ inverse(T_b_body))
