"""The robot bridge as a process: the agent's poses, the robot's DDS domain and commanders, in one loop.

The state machine decides (`share.robot.bridge`); this carries its effects out.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

from share.errors import WireError
from share.geometry.se3 import inverse
from share.net.udp import Datagram, StampedSocket
from share.protocol.common_events import PrintLine, Tick
from share.protocol.room_events import MessageWanted, RobotCommanded
from share.robot import robot_events as ev
from share.robot.bridge import RobotBridge
from share.robot.goal_control import GOAL_PREFIX
from share.robot.grid import FloorMap
from share.robot.planar import PlanarPose
from share.robot.pose_message import parse_pose_message
from share.robot.robot_file import RobotDescription
from share.robot.wire_commands import WireCommands
from share.runtime.robot_commands import CommandServer
from share.runtime.room_link import RoomLink
from share.timing import LineLimiter
from share.types import F64
from share.wire.room_messages import CommandState

_TICK_S = 0.01  # odometry waits so long at most
_END_NS = 2_000_000_000
_MAX_DATAGRAMS = 64  # in one step


class RobotConnection(Protocol):
    """The robot's topics: by DDS (`RosNode`), or by way of a node on the robot (`NodeLink`)."""

    def poll(self, now_ns: int) -> list[ev.RobotEvent]:
        """Return what has come; never waits."""
        ...

    def publish_map_odom(self, stamp_ns: int, T_map_odom: PlanarPose) -> None: ...

    def publish_body(self, T_base_body: F64) -> None: ...

    def publish_grid(self, grid: FloorMap) -> None: ...

    def limit_speed(self, speed_m_s: float) -> None: ...

    def send_goal(self, goal: ev.SendGoal) -> None: ...

    def cancel_goal(self, goal_id: bytes) -> None: ...

    def ask_result(self, goal_id: bytes) -> None: ...


def received_pose(datagram: Datagram) -> ev.AgentPoseReceived:
    """Return the pose of a datagram, as old as it is now. Raises WireError."""
    pose = parse_pose_message(datagram.data)
    waited_ns = max(0, time.time_ns() - datagram.stamp_ns)
    return replace(pose, age_ns=(pose.age_ns or 0) + waited_ns)


class RobotBridgeRun:
    """One bridge until `stop`. print_line: takes lines for a person. room: the edge that sends goals too."""

    def __init__(
        self,
        robot: RobotDescription,
        node: RobotConnection,
        poses: StampedSocket,
        commands: CommandServer,
        print_line: Callable[[str], None],
        room: RoomLink | None = None,
    ) -> None:
        self.bridge = RobotBridge(robot.settings)
        self._room, self._wire = room, WireCommands()
        self._node, self._poses, self._commands, self._print_line = node, poses, commands, print_line
        self._line_limiter = LineLimiter()
        self._is_stopped = False
        node.publish_grid(robot.grid)
        node.publish_body(inverse(robot.settings.T_body_base))

    def stop(self) -> None:
        """End the run; may be called by a signal handler."""
        self._is_stopped = True

    def run(self) -> None:
        """Serve until stopped; then, or after an error, cancel the goal under way, and wait a moment until
        the robot confirms it."""
        try:
            while not self._is_stopped:
                self.step(_TICK_S)
        finally:
            self._end_goal()

    def _end_goal(self) -> None:
        self._handle(ev.CancelRequested("the end of the bridge"))
        end_ns = time.monotonic_ns() + _END_NS
        while self.bridge.has_goal and time.monotonic_ns() < end_ns:
            self.step(_TICK_S)

    def step(self, wait_s: float) -> None:
        """Wait for a pose, at most `wait_s`, and handle all that has come."""
        datagram = self._poses.receive(wait_s)
        for _ in range(_MAX_DATAGRAMS):
            if datagram is None:
                break
            self._take_pose(datagram)
            datagram = self._poses.receive(0)
        for event in self._node.poll(time.monotonic_ns()):
            self._handle(event)
        for event in self._commands.poll(self._goal_id):
            self._handle(event)
        if self._room is not None:
            self._serve_edge(self._room)
        self._handle(Tick())
        self._commands.show(lambda: self.bridge.report(time.monotonic_ns()), time.monotonic_ns())

    def _serve_edge(self, room: RoomLink) -> None:
        """Take the commands that have come over the wire, and answer."""
        now_ns = time.monotonic_ns()
        for effect in room.step(0):
            if isinstance(effect, RobotCommanded):
                self._carry_out(room, *self._wire.take(effect.command, self._goal_id, now_ns))
        self._carry_out(room, *self._wire.tick(now_ns))
        place = self._wire.due_place(lambda: self.bridge.report(now_ns), now_ns)
        if place is not None:
            room.handle(MessageWanted(place))

    def _carry_out(self, room: RoomLink, events: list[ev.RobotEvent], states: list[CommandState]) -> None:
        for state in states:
            room.handle(MessageWanted(state))
        for event in events:
            self._handle(event)

    def _report(self, report: ev.GoalReport) -> None:
        self._commands.report(report)
        if self._room is not None:
            state = self._wire.report(report, time.monotonic_ns())
            if state is not None:
                self._room.handle(MessageWanted(state))

    def _goal_id(self) -> bytes:
        return GOAL_PREFIX + secrets.token_bytes(16 - len(GOAL_PREFIX))

    def _take_pose(self, datagram: Datagram) -> None:
        try:
            pose = received_pose(datagram)
        except WireError as error:
            line = self._line_limiter.admit_new(f"what comes as a pose is none: {error}", time.monotonic_ns())
            if line is not None:
                self._print_line(line)
            return
        self._handle(pose)

    def _handle(self, event: ev.RobotEvent) -> None:
        for effect in self.bridge.handle(event, time.monotonic_ns()):
            match effect:
                case ev.PublishMapOdom():
                    self._node.publish_map_odom(effect.stamp_ns, effect.T_map_odom)
                case ev.SendGoal():
                    self._node.send_goal(effect)
                case ev.CancelGoal():
                    self._node.cancel_goal(effect.goal_id)
                case ev.AskResult():
                    self._node.ask_result(effect.goal_id)
                case ev.LimitSpeed():
                    self._node.limit_speed(effect.speed_m_s)
                case ev.GoalReport():
                    self._report(effect)
                case PrintLine():
                    self._print_line(effect.text)
                    self._commands.notify_watchers({"line": effect.text})
