"""A robot in the loop without pictures: it and a headset see points on the walls of an empty room."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from helpers.edge_sim import FOCAL, Person, hello_of, look, walls
from helpers.room_simulation import tracked_frames

from share.config import Config, EdgeConfig
from share.geometry import se3
from share.lab.emulate.motion.route import Floor
from share.lab.emulate.types import START_NS
from share.lab.evaluate.emulated_network import NETWORK_PRESETS
from share.lab.evaluate.simulation import TrackedFrame
from share.lab.robot.base import RobotBase
from share.lab.robot.drive import DriveModel
from share.lab.robot.giver import GoalGiver, HeadsetPointing
from share.lab.robot.goals import drawn_goals
from share.lab.robot.loop import ROBOT, RobotLoop
from share.lab.robot.planner import RoomGrid
from share.lab.robot.simulate import usual_robot
from share.robot.planar import PlanarPose
from share.robot.settings import RobotSettings
from share.types import F64, AgentKind, OdometryKeyframe, TrackState

SIZE = np.array([8.0, 6.0])
STEP_M = 0.1
PERIOD_NS = 50_000_000
WALLS = walls(1)
START = PlanarPose(2.0, 2.0, 0.0)


def empty_room() -> RoomGrid:
    """A floor with nothing but walls around it."""
    x, y = (STEP_M * (np.arange(round(side / STEP_M)) + 0.5) for side in SIZE)
    clearance = np.minimum(np.minimum(x, SIZE[0] - x)[:, None], np.minimum(y, SIZE[1] - y)[None, :])
    return RoomGrid(Floor(clearance, STEP_M, STEP_M / 2))


class SeeingAgent:
    """The robot's tracker, as good as a real one: odometry drifts by 1 mm a keyframe, and is lost where
    nothing is seen."""

    def __init__(self, base: RobotBase, seconds: float) -> None:
        self.hello = hello_of(ROBOT, 100, AgentKind.ROBOT, focal=FOCAL)
        self.frame_times_ns = list(range(PERIOD_NS, round(seconds * 1e9), PERIOD_NS))
        self._base, self._rng = base, np.random.default_rng(5)
        self._sees_wall = False
        self._forget()

    def _forget(self) -> None:
        self._T_world_odom: F64 | None = None
        self._T_before: F64 | None = None
        self._count = 0

    def restart(self, now_ns: int) -> None:
        self.hello = replace(self.hello, run_id=self.hello.run_id + 1)
        self._forget()

    def show_bare_wall(self, is_shown: bool) -> None:
        self._sees_wall = is_shown
        if is_shown:
            self._forget()

    def frame(self, number: int) -> TrackedFrame:
        now_ns = self.frame_times_ns[number]
        T_world_body = self._base.body.part(now_ns, now_ns).poses(np.array([now_ns + START_NS]))[0]
        if self._sees_wall:
            return TrackedFrame(now_ns, None, state=TrackState.LOST)
        if self._T_world_odom is None:
            level = se3.from_rt(np.eye(3), T_world_body[:3, 3])
            self._T_world_odom = level
        T = se3.inverse(self._T_world_odom) @ T_world_body
        self._count += 1
        if self._count % 5 != 1:
            return TrackedFrame(now_ns, T, 0.5, cov=1e-6 * np.eye(6), new_segment=self._count == 1)
        self._T_world_odom = self._T_world_odom @ se3.exp(self._rng.normal(0, 0.001, 6) * (0, 0, 1, 1, 1, 0))
        T = se3.inverse(self._T_world_odom) @ T_world_body
        before = self._T_before
        T_last_body = T if before is None else se3.inverse(before) @ T
        view = look(WALLS, T_world_body, self._rng)
        candidate = OdometryKeyframe(T, T_last_body, 4e-6 * np.eye(6), np.zeros(3), 0.0, view, before is None)
        self._T_before = T
        return TrackedFrame(now_ns, T, 0.5, candidate, cov=1e-6 * np.eye(6), new_segment=before is None)


class Drive:
    """A robot and a headset, ann, whose wearer gives `goals`. ann_s: when ann comes."""

    loop_type: Any = RobotLoop

    def __init__(
        self,
        goals: list[PlanarPose],
        seconds: float = 60.0,
        settings: RobotSettings | None = None,
        ann_s: float = 0.0,
        has_ann: bool = True,
    ) -> None:
        settings = settings or usual_robot()
        rng = np.random.default_rng(3)
        T_base_body = se3.inverse(settings.T_body_base)
        self.grid = empty_room()
        self.base = RobotBase(DriveModel(), self.grid, START, T_base_body, seconds + 1, rng)
        self.agent = SeeingAgent(self.base, seconds)
        self.ann = Person("ann", WALLS, 0.3, 11)
        late_ns = round(ann_s * 1e9)
        frames = (
            replace(one, arrival_ns=one.arrival_ns + late_ns, stamp_ns=one.arrival_ns + late_ns)
            for one in tracked_frames(self.ann, seconds)
        )
        link = NETWORK_PRESETS["wifi5"]
        members = [(self.ann.hello, frames, link)] if has_ann else []
        config = Config(edge=EdgeConfig(policy="covins-g"))
        self.ann_link = link
        self.loop = self.loop_type(
            config,
            members,
            1,
            self.base,
            self.grid,
            lambda now_ns: np.zeros((0, 2)),
            settings,
            self.agent,
            link,
        )

        def ann_pose(now_ns: int) -> F64:
            return self.ann.T_world_body[max(0, now_ns - late_ns) // (5 * PERIOD_NS)]

        def own_pose(now_ns: int) -> F64:
            return self.base.body.part(now_ns, now_ns).poses(np.array([now_ns + START_NS]))[0]

        given = iter(goals)
        by_ann = HeadsetPointing(self.loop, "ann", ann_pose)
        alone = HeadsetPointing(self.loop, ROBOT, own_pose)
        first = drawn_goals(self.grid, np.random.default_rng(4))
        self.giver = GoalGiver(self.loop, lambda here: next(given), len(goals), by_ann, first, alone)
        if not has_ann:
            self.giver = GoalGiver(self.loop, lambda here: next(given), len(goals), alone)

    def run(self, until_s: float) -> None:
        """Go on until all goals have their end, or a time."""
        now_s = self.loop.now_ns / 1e9
        while now_s < until_s and not self.giver.is_done:
            now_s += 0.5
            self.loop.run(now_s)

    def run_until(self, is_so: Callable[[], bool], limit_s: float) -> None:
        """Go on until something is so. Fails where it is not, in time."""
        while not is_so():
            assert self.loop.now_ns / 1e9 < limit_s, self.loop.lines
            self.loop.run(self.loop.now_ns / 1e9 + 0.1)

    @property
    def speed_m_s(self) -> float:
        return self.base.at(self.loop.now_ns).speed_m_s

    @property
    def texts(self) -> list[str]:
        return [text for _, text in self.loop.lines]

    @property
    def navigator_has_place(self) -> bool:
        """Whether the robot's navigation still knows where it is."""
        return self.loop.navigator.has_place(self.loop.now_ns)
