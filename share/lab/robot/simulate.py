"""`share robot simulate`: a session's room and people, and a robot that is sent about in it."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from share.config import Config, with_policy
from share.errors import UsageError
from share.geometry.se3 import inverse
from share.lab.emulate.recipe import Progress
from share.lab.emulate.sensor.device import EmulatedDevice
from share.lab.emulate.types import START_NS
from share.lab.evaluate.emulated_network import NETWORK_PRESETS, NetworkModel
from share.lab.evaluate.simulation import TrackedFrame
from share.lab.evaluate.virtual_time import track_session, tracked_frame
from share.lab.robot.base import RobotBase
from share.lab.robot.drive import DriveModel
from share.lab.robot.faults import LoopFault, schedule_faults
from share.lab.robot.giver import GoalGiver, HeadsetPointing, points_in_room
from share.lab.robot.goals import GoalOutcome, drawn_goals, start_pose
from share.lab.robot.loop import ROBOT, Member, RobotLoop
from share.lab.robot.room import Bodies, EmulatedRoom
from share.lab.robot.sensors import RobotSensors
from share.odometry.error_model.network import open_error_model
from share.recordings.session import Session
from share.robot.planar import PlanarPose
from share.robot.robot_file import T_base_of_camera
from share.robot.settings import RobotSettings
from share.runtime.error_estimators import ErrorEstimator, NoErrorEstimate, SynchronousErrorModel
from share.runtime.fault_guard import FaultGuard
from share.runtime.guarded_tracker import GuardedTracker
from share.runtime.offline_tracking import track_frames
from share.sensors.profile import load_profile
from share.types import AgentKind
from share.wire.messages import Hello

SHARE, TRUTH, WHEELS = "share", "truth", "wheels"
LINK = "wifi5"
ROBOT_RUN = 1000  # run id; those of the session's agents are 1, 2, …
_FRAME_HZ = 15.0  # of a robot that knows its true place
_STEP_S = 0.5
_CAMERA_M = (0.09, 0.018, 0.21)


@dataclass(frozen=True, eq=False)
class LoopOptions:
    """goals: to be given, in the room; None: `count` drawn ones. seconds: the longest run. profile: of the
    robot's device."""

    localisation: str = SHARE
    policy: str = SHARE
    count: int = 5
    goals: tuple[PlanarPose, ...] | None = None
    seed: int = 0
    seconds: float = 300.0
    profile: str = "d435i:640x480@15"
    faults: tuple[LoopFault, ...] = ()


def usual_robot() -> RobotSettings:
    """Return the robot of the docs' example, a little faster, without an area."""
    T_base_body = T_base_of_camera(_CAMERA_M)
    return RobotSettings(inverse(T_base_body), allow_goals=True, max_speed_m_s=0.3)


class EmulatedRobotAgent:
    """The robot's tracker on frames of its emulated device."""

    def __init__(
        self, sensors: RobotSensors, settings: Config, run_id: int, notify: Callable[[str], None]
    ) -> None:
        self.hello = Hello(ROBOT, AgentKind.ROBOT, run_id, sensors.rig)
        self.frame_times_ns: Sequence[int] = sensors.frame_times_ns
        self._sensors = sensors
        self._make_tracker = partial(GuardedTracker, sensors.rig, settings, FaultGuard(notify))
        self._tracker = self._make_tracker()
        model = settings.agent.error_model
        self._errors: ErrorEstimator = (
            SynchronousErrorModel(open_error_model(model)) if model else NoErrorEstimate()
        )

    def frame(self, number: int) -> TrackedFrame:
        """Draw frame `number` and track it."""
        [step] = track_frames(iter([self._sensors.frame(number)]), self._tracker, self._errors)
        return tracked_frame(step, START_NS)

    def restart(self, now_ns: int) -> None:
        """Begin another run, at a session time."""
        self.hello = replace(self.hello, run_id=self.hello.run_id + 1)
        self._tracker = self._make_tracker()
        self._sensors.restart(now_ns)

    def show_bare_wall(self, is_shown: bool) -> None:
        self._sensors.sees_bare_wall = is_shown


@dataclass(frozen=True, eq=False)
class LoopRun:
    """A run, before or after its drive. giver: with the goals' outcomes."""

    options: LoopOptions
    loop: RobotLoop
    giver: GoalGiver

    @property
    def outcomes(self) -> list[GoalOutcome]:
        return self.giver.outcomes

    def drive(self) -> Iterator[float]:
        """Go on, and yield the session time, s, every so often, until all goals have their end or the run
        has."""
        now_s = 0.0
        while now_s < self.options.seconds and not self.giver.is_done:
            now_s += _STEP_S
            self.loop.run(now_s)
            yield now_s


def prepare_run(
    session: Session | None,
    room: EmulatedRoom,
    options: LoopOptions,
    config: Config,
    robot: RobotSettings,
    progress: Progress,
) -> LoopRun:
    """Return a robot that is to be sent about in a session's room. session: None without pictures, where the
    robot does not see. Deterministic for given options. Raises UsageError."""
    loop, giver = _loop(session, room, options, config, robot, progress)
    schedule_faults(loop, options.faults)
    return LoopRun(options, loop, giver)


def _loop(
    session: Session | None,
    room: EmulatedRoom,
    options: LoopOptions,
    config: Config,
    robot: RobotSettings,
    progress: Progress,
) -> tuple[RobotLoop, GoalGiver]:
    rngs = [np.random.default_rng((options.seed, stream)) for stream in range(4)]
    T_world_base = start_pose(room.grid, room.people_at(0), rngs[0])
    T_base_body = inverse(robot.T_body_base)
    base = RobotBase(DriveModel(), room.grid, T_world_base, T_base_body, options.seconds, rngs[1])
    config = with_policy(config, options.policy)
    common = (options.seed, base, room.grid, room.people_at, robot)
    network = NETWORK_PRESETS[LINK]
    draw, count = _goal_source(room, options, rngs[2])
    if options.localisation != SHARE:
        times = [round(1e9 * k / _FRAME_HZ) for k in range(int(options.seconds * _FRAME_HZ))]
        own_pose = _own_pose(base, options.localisation)
        loop = RobotLoop(config, [], *common, None, network, own_pose, times)
        return loop, GoalGiver(loop, draw, count, points_in_room)
    if session is None:
        raise ValueError("a robot that sees needs the session's recordings")
    members = tracked_people(session, room, config, network, progress)
    sensors = robot_sensors(room, base, options.profile, options.seed, options.seconds)
    agent = EmulatedRobotAgent(sensors, config, ROBOT_RUN, lambda text: loop.note(f"agent: {text}"))
    loop = RobotLoop(config, members, *common, agent, network)
    alone = HeadsetPointing(loop, ROBOT, lambda now_ns: base.body.part(now_ns, now_ns).poses(_at(now_ns))[0])
    if not room.people:
        return loop, GoalGiver(loop, draw, count, alone)
    wearer = room.people[0]

    def wearer_pose(now_ns: int) -> Any:
        return wearer.path.poses(np.array([now_ns + wearer.path.start_ns]))[0]

    pointing = HeadsetPointing(loop, wearer.name, wearer_pose)
    return loop, GoalGiver(loop, draw, count, pointing, drawn_goals(room.grid, rngs[3]), alone)


def _at(session_ns: int) -> Any:
    return np.array([session_ns + START_NS])


def _own_pose(base: RobotBase, localisation: str) -> Callable[[int], PlanarPose]:
    T_world_start = base.steps[0].T_world_base
    if localisation == TRUTH:
        return lambda now_ns: base.at(now_ns).T_world_base
    return lambda now_ns: T_world_start @ base.at(now_ns).T_odom_base


def _goal_source(
    room: EmulatedRoom, options: LoopOptions, rng: np.random.Generator
) -> tuple[Callable[[PlanarPose], PlanarPose], int]:
    if options.goals is None:
        return drawn_goals(room.grid, rng), options.count
    for goal in options.goals:
        if room.grid.clearance(goal) <= 0:
            raise UsageError(f"goal x {goal.x:g} y {goal.y:g} m is not on the room's free floor")
    given = iter(options.goals)
    return lambda here: next(given), len(options.goals)


def tracked_people(
    session: Session, room: EmulatedRoom, config: Config, network: NetworkModel, progress: Progress
) -> list[Member]:
    """Return the session's headsets, tracked from their files; once where runs follow each other."""
    if not room.people:
        return []
    names = tuple(person.name for person in room.people)
    progress(f"tracking {', '.join(names)}", 0, 1)
    settings = config.tracker, config.inertial, config.sequencer
    tracked = track_session(session.folder.resolve(), *settings, config.agent.error_model, names)
    members: list[Member] = []
    for number, person in enumerate(room.people, 1):
        rig, frames = tracked[person.name]
        hello = Hello(person.name, person.kind, number, rig)
        arriving = (replace(one, arrival_ns=one.arrival_ns - START_NS) for one in frames)
        members.append((hello, arriving, network))
    progress(f"tracking {', '.join(names)}", 1, 1)
    return members


def robot_sensors(
    room: EmulatedRoom, base: RobotBase, profile_text: str, seed_number: int, seconds: float
) -> RobotSensors:
    """Return the robot's device in a room. profile_text: `NAME` or `NAME:MODE`; seconds: of the run."""
    name, _, mode = profile_text.partition(":")
    profile = load_profile(name, mode or None)
    seed = (seed_number, zlib.crc32(b"robot's device"))
    device = EmulatedDevice(profile, room.recipe.effects, seed, START_NS, (room.recipe.motion_seed, 8))
    bodies = Bodies(room.people)
    return RobotSensors(profile.rig(depth=False), device, room.open_renderer(), base.body, bodies.at, seconds)
