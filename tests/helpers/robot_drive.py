"""A robot that drives, its agent and its navigation, in made-up time, for the robot bridge."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from share.geometry.se3 import from_rt, inverse, so3_exp
from share.protocol.common_events import Tick
from share.robot import robot_events as ev
from share.robot.bridge import RobotBridge
from share.robot.planar import PlanarPose
from share.robot.settings import RobotSettings
from share.types import F64, TrackState

SECOND = 1_000_000_000
UNIX_NS = 1_700_000_000 * SECOND  # of the host's 0
T_BASE_BODY = from_rt(so3_exp(np.array([0.1, -1.5, 0.3])), np.array([0.07, -0.02, 0.2]))


def solid(pose: PlanarPose, z: float = 0.0) -> F64:
    """The pose as (4, 4)."""
    return from_rt(so3_exp(np.array([0.0, 0.0, pose.yaw])), np.array([pose.x, pose.y, z]))


class RobotDrive:
    """A robot on an arc, seen by a bridge: poses at 30 Hz 15 ms old, odometry at 20 Hz 8 ms old, stamped by a
    clock that is `ahead_ns` of the host's."""

    def __init__(self, settings: RobotSettings | None = None, ahead_ns: int = 37_000_000) -> None:
        settings = settings or RobotSettings(allow_goals=True)
        self.bridge = RobotBridge(replace(settings, T_body_base=inverse(T_BASE_BODY)))
        self.ahead_ns, self.now_ns, self.sequence = ahead_ns, 5 * SECOND, 0
        self.T_map_odom = PlanarPose(2.0, -1.0, 0.7)
        self.map_id, self.state, self.sigma_m, self.has_edge = "ann-1/0", TrackState.OK, 0.02, True
        self.is_tracked = self.is_driven = True  # whether poses and odometry come
        self.speed_m_s, self.goals = 0.2, ()
        self.effects: list[ev.RobotEffect] = []
        self.handle(ev.RobotDiscovered(1, 1, release="jazzy"))

    def T_odom_base(self, now_ns: int) -> PlanarPose:
        """Where odometry has the robot at a time of the host."""
        t = now_ns / SECOND
        return PlanarPose(math.sin(0.2 * t), 1 - math.cos(0.2 * t), 0.2 * t)

    def handle(self, event: ev.RobotEvent) -> list[ev.RobotEffect]:
        effects = self.bridge.handle(event, self.now_ns)
        self.effects += effects
        return effects

    def pose(self, **changed: object) -> ev.AgentPoseReceived:
        """The agent's newest pose."""
        T = solid(self.T_map_odom @ self.T_odom_base(self.now_ns - 15_000_000)) @ T_BASE_BODY
        self.sequence += 1
        has_pose = self.state.has_pose
        pose = ev.AgentPoseReceived(
            "bot",
            self.sequence,
            self.state,
            T if has_pose else None,
            self.map_id if has_pose else None,
            self.sigma_m,
            15_000_000,
            self.has_edge,
        )
        return replace(pose, **changed)

    def odometry(self) -> ev.OdometryReceived:
        made_ns = self.now_ns - 8_000_000
        return ev.OdometryReceived(
            made_ns + UNIX_NS + self.ahead_ns,
            self.now_ns + UNIX_NS,
            self.T_odom_base(made_ns),
            self.speed_m_s,
        )

    def run(self, seconds: float) -> list[ev.RobotEffect]:
        """Go on for a time. Return the effects."""
        begin = len(self.effects)
        for _ in range(round(seconds * 100)):
            self.now_ns += SECOND // 100
            step = self.now_ns // (SECOND // 100)
            if self.is_driven and step % 5 == 0:
                self.handle(self.odometry())
            if self.is_tracked and step % 3 == 0:
                self.handle(self.pose())
            if self.goals and step % 10 == 0:
                self.handle(ev.StatusReceived(tuple(self.goals)))
            self.handle(Tick())
        return self.effects[begin:]

    def goto(self, x: float = 3.0, y: float = 0.0, commander: str = "ann", **more: object) -> bytes:
        """Ask for a goal. Return its id."""
        goal_id = b"SHARE\x00\x00\x01" + self.sequence.to_bytes(8, "big")
        self.handle(ev.GotoRequested(commander, goal_id, x, y, **more))
        return goal_id

    def of(self, kind: type) -> list:
        """All effects of a kind."""
        return [effect for effect in self.effects if isinstance(effect, kind)]

    @property
    def last_report(self) -> ev.GoalReport:
        return self.of(ev.GoalReport)[-1]
