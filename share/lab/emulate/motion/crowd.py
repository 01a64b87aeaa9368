"""Plan several simulated agents on one floor: tracks that keep apart, then bodies that look at each other.

An agent that finds no schedule tries other tours; if none works, all are planned again with another seed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np

from share.errors import UsageError
from share.lab.emulate.motion import robot, walk
from share.lab.emulate.motion.route import Floor, FloorGraph, Route, arc_length
from share.lab.emulate.motion.schedule import STEP_S, MotionLimits, MovingObstacle, plan_schedule, speed_limit
from share.lab.emulate.motion.spline import SplinePath
from share.lab.emulate.motion.track import KNOT_S, PlanarTrack, knot_times
from share.lab.emulate.motion.walk import GazeAgent
from share.lab.emulate.types import START_NS, MotionPath
from share.types import F64

PEOPLE_M, ROBOT_M = 0.6, 0.5  # least distance from others at any time
_SPARE_DISTANCE_M = 0.17  # added to distances in planning, for leaning heads and smoothed schedules
_MAX_TOURS = 12  # per agent, before all are planned again
_GRID_TOLERANCE_M = 0.05  # of the grid
_START_DELAY_S = 1.2  # smoothing in time lets motion begin earlier by this
_PAUSE_S = (1.5, 4.5)
_ROUGH_LENGTH_TOLERANCE = 0.15  # relative; the rest is corrected later
_LENGTH_RESERVE = 1.08  # planned length over the wanted one, for time lost in bends
_BODY_MODULES: dict[str, ModuleType] = {"person": walk, "robot": robot}


@dataclass(frozen=True)
class MotionPreferences:
    """body_kind: `person` or `robot`. speed: m/s. length: m to travel, None for any."""

    body_kind: str
    speed: float
    pauses_per_minute: float
    length: float | None = None

    @property
    def limits(self) -> MotionLimits:
        """Return the limits of the body."""
        found: MotionLimits = _BODY_MODULES[self.body_kind].motion_limits(self.speed)
        return found

    @property
    def distance(self) -> float:
        """Return the least distance (m) that others keep from it."""
        return PEOPLE_M if self.body_kind == "person" else ROBOT_M


class FloorGraphs:
    """A floor and its graph for each kind of body, made once for all attempts."""

    def __init__(self, floor: Floor) -> None:
        self.floor = floor
        self._graphs: dict[str, FloorGraph] = {}

    def graph_of(self, body_kind: str) -> FloorGraph:
        """Return the floor that such a body can reach."""
        if body_kind not in self._graphs:
            self._graphs[body_kind] = FloorGraph(self.floor, _BODY_MODULES[body_kind].RADIUS)
        return self._graphs[body_kind]


@dataclass(frozen=True, eq=False)
class PlannedRoute:
    """A route with its speed limits (N,) m/s and the target speed (T,) m/s of each step."""

    body_kind: str
    route: Route
    speed_limits: F64
    target_speeds: F64

    def track(
        self, ground: FloorGraphs, obstacles: Sequence[MovingObstacle], duration: float, length: float | None
    ) -> PlanarTrack | None:
        """Return a track on the route that keeps off `obstacles` and is `length` m long; None if there is
        none."""
        body = _BODY_MODULES[self.body_kind]
        steps = plan_schedule(self.route, self.speed_limits, self.target_speeds, obstacles, length)
        if steps is None:
            return None
        track: PlanarTrack = body.track_on_route(self.route, steps, duration)
        fits = ground.floor.clearance_at(track.xy[::20]).min() >= body.RADIUS - _GRID_TOLERANCE_M
        return track if fits else None


def plan_motion(
    ground: FloorGraphs,
    preferences: MotionPreferences,
    obstacles: Sequence[MovingObstacle],
    duration: float,
    seed: tuple[int, ...],
) -> tuple[PlannedRoute, PlanarTrack] | None:
    """Return a route and a track of `duration` s that keeps off `obstacles`; None if no tour has one."""
    for attempt in range(_MAX_TOURS):
        course = _plan_route(ground, preferences, duration, np.random.default_rng((*seed, attempt)))
        track = course.track(ground, obstacles, duration, preferences.length) if course else None
        if course and track and _has_length(track, preferences.length):
            return course, track
    return None


def _has_length(track: PlanarTrack, length: float | None) -> bool:
    """Return whether a track is near to the wanted length; others may force it to be longer or shorter."""
    return length is None or abs(arc_length(track.xy[::10])[-1] / length - 1) < _ROUGH_LENGTH_TOLERANCE


def _plan_route(
    ground: FloorGraphs, preferences: MotionPreferences, duration: float, rng: np.random.Generator
) -> PlannedRoute | None:
    body = _BODY_MODULES[preferences.body_kind]
    target_speeds = _target_speeds(preferences, body.INITIAL_STILL_S, duration, rng)
    longest = 1.3 * max(target_speeds.sum() * STEP_S, preferences.length or 0.0) + 1.0
    legs = ground.graph_of(preferences.body_kind).random_tour(longest, rng)
    if not legs:
        return None
    route: Route = body.route_from_legs(ground.floor, legs)
    return PlannedRoute(preferences.body_kind, route, speed_limit(route, preferences.limits), target_speeds)


def moving_obstacle(xy: F64, distance: float) -> MovingObstacle:
    """Return an obstacle with places xy (M, 2) m every KNOT_S."""
    return MovingObstacle(xy[:: round(STEP_S / 2 / KNOT_S)], distance + _SPARE_DISTANCE_M)


def min_distance(a: F64, b: F64) -> float:
    """Return the least horizontal distance (m) of two at a and b (N, 2 or 3) at the same times."""
    return float(np.linalg.norm(a[:, :2] - b[:, :2], axis=1).min())


def _target_speeds(
    preferences: MotionPreferences, still: float, duration: float, rng: np.random.Generator
) -> F64:
    """Return the speed (T,) m/s of each step of the schedule: standing at first, random pauses, and as many
    more as leave about `preferences.length` m."""
    steps = int(np.ceil(duration / STEP_S)) + 1
    t = (np.arange(steps) + 0.5) * STEP_S
    speed = np.where(t < still + _START_DELAY_S, 0.0, preferences.speed)
    count = int(np.floor(preferences.pauses_per_minute * duration / 60 + rng.random()))
    while count > 0 or (
        preferences.length is not None and speed.sum() * STEP_S > _LENGTH_RESERVE * preferences.length
    ):
        pause_start, pause_s = rng.uniform(min(still + 3, duration / 2), duration), rng.uniform(*_PAUSE_S)
        speed[(t > pause_start) & (t < pause_start + pause_s)] = 0.0
        count -= 1
    return speed


# All agents together.

_ATTEMPTS = 60
_LENGTH_ROUNDS = 6  # replanning rounds that adjust path lengths
_MIN_IMPROVEMENT = 0.7  # a round must reduce length errors to this share, else a new attempt starts
_LENGTH_TOLERANCE = 0.010  # path lengths are those of poses at 30 Hz
_LENGTH_STEP_S = 1 / 30  # a length is that of the line through poses at 30 Hz


@dataclass(frozen=True)
class SimulatedAgent:
    """One simulated agent. height: m, of eyes or camera. max_head_rate: rad/s, of a person. vibration: m/s^2,
    of a robot. length: m of the body's path at 30 Hz, None for any."""

    name: str
    preferences: MotionPreferences
    height: float
    max_head_rate: float = 2.6
    vibration: float = 0.4
    length: float | None = None


@dataclass(frozen=True, eq=False)
class FixedPath:
    """A path that is fixed. xyz (M, 3) m every KNOT_S from its start; distance: m that others keep from
    it."""

    xyz: F64
    distance: float


def plan_crowd(
    ground: FloorGraphs,
    members: Sequence[SimulatedAgent],
    fixed: Sequence[FixedPath],
    gaze_targets: F64,
    duration: float,
    seed: tuple[int, ...],
) -> list[SplinePath]:
    """Return paths of `duration` s, in the members' order. gaze_targets (K, 3) m: things to look at. Raises
    UsageError where no attempt finds room for all."""
    for attempt in range(_ATTEMPTS):
        paths = _try_crowd(ground, members, fixed, gaze_targets, duration, (*seed, attempt))
        if paths is not None:
            return paths
    names = ", ".join(m.name for m in members)
    raise UsageError(
        f"{names}: found no paths that keep people {PEOPLE_M} m and robots {ROBOT_M} m apart in this room; "
        "use fewer agents, lower speeds, a larger --size or another --seed"
    )


def _try_crowd(
    ground: FloorGraphs,
    members: Sequence[SimulatedAgent],
    fixed: Sequence[FixedPath],
    gaze_targets: F64,
    duration: float,
    seed: tuple[int, ...],
) -> list[SplinePath] | None:
    lengths = [m.length for m in members]
    courses_and_tracks = _plan_courses(ground, members, fixed, duration, seed)
    before = np.full(len(members), np.inf)
    for _ in range(_LENGTH_ROUNDS):
        if courses_and_tracks is None:
            return None
        paths = _body_paths(
            members, [track for _, track in courses_and_tracks], fixed, gaze_targets, duration, seed
        )
        missing = np.array(
            [m.length - path_length(p) if m.length else 0.0 for m, p in zip(members, paths, strict=True)]
        )
        length_errors = np.abs(missing) / [m.length or 1.0 for m in members]
        if (length_errors <= _LENGTH_TOLERANCE).all():
            return paths if _keep_distance(members, paths, fixed) else None
        if (length_errors > np.maximum(_LENGTH_TOLERANCE, _MIN_IMPROVEMENT * before)).any():
            return None  # a length cannot be reached, or another agent forces a longer path
        before = length_errors
        lengths = [g and max(0.5, g + d) for g, d in zip(lengths, missing, strict=True)]
        courses_and_tracks = _replan_lengths(
            ground, members, fixed, duration, [course for course, _ in courses_and_tracks], lengths
        )
    return None


def path_length(path: MotionPath) -> float:
    """Return the length (m) of the body's path at 30 Hz, as `share dataset info` counts it."""
    stamps = np.arange(path.start_ns, path.end_ns + 1, round(_LENGTH_STEP_S * 1e9))
    steps = np.diff(path.poses(stamps)[:, :3, 3], axis=0)
    return float(np.linalg.norm(steps, axis=1).sum())


def fixed_path(path: MotionPath, distance: float) -> FixedPath:
    """Return a fixed path as an obstacle for others."""
    seconds = knot_times((path.end_ns - path.start_ns) / 1e9)
    stamps = np.minimum(path.start_ns + np.round(seconds * 1e9).astype(np.int64), path.end_ns)
    return FixedPath(path.poses(stamps)[:, :3, 3], distance)


def _plan_courses(
    ground: FloorGraphs,
    members: Sequence[SimulatedAgent],
    fixed: Sequence[FixedPath],
    duration: float,
    seed: tuple[int, ...],
) -> list[tuple[PlannedRoute, PlanarTrack]] | None:
    """Return a route for each member, and the track on it; None if there is none."""
    planned: dict[int, tuple[PlannedRoute, PlanarTrack]] = {}
    for i in _priority_order(members):
        obstacles = _obstacles(members, fixed, {k: track for k, (_, track) in planned.items()}, i)
        preferences = replace(members[i].preferences, length=members[i].length)
        one = plan_motion(ground, preferences, obstacles, duration, (*seed, i))
        if one is None:
            return None
        planned[i] = one
    return [planned[i] for i in range(len(members))]


def _replan_lengths(
    ground: FloorGraphs,
    members: Sequence[SimulatedAgent],
    fixed: Sequence[FixedPath],
    duration: float,
    courses: Sequence[PlannedRoute],
    lengths: Sequence[float | None],
) -> list[tuple[PlannedRoute, PlanarTrack]] | None:
    """Return the same routes with tracks of other lengths; None if there are none."""
    tracks: dict[int, PlanarTrack] = {}
    for i in _priority_order(members):
        track = courses[i].track(ground, _obstacles(members, fixed, tracks, i), duration, lengths[i])
        if track is None:
            return None
        tracks[i] = track
    return [(courses[i], tracks[i]) for i in range(len(members))]


def _priority_order(members: Sequence[SimulatedAgent]) -> list[int]:
    """Return the planning order: the fastest first, since they have the least time to spare."""
    return sorted(range(len(members)), key=lambda i: -members[i].preferences.speed)


def _obstacles(
    members: Sequence[SimulatedAgent],
    fixed: Sequence[FixedPath],
    tracks: Mapping[int, PlanarTrack],
    i: int,
) -> list[MovingObstacle]:
    """Return the obstacles of member i: all with a planned motion."""
    own = members[i].preferences
    fixed_tracks = [(p.xyz[:, :2], p.distance) for p in fixed]
    fixed_tracks += [(track.xy, members[k].preferences.distance) for k, track in tracks.items()]
    return [moving_obstacle(xy, min(distance, own.distance)) for xy, distance in fixed_tracks]


def _body_paths(
    members: Sequence[SimulatedAgent],
    tracks: Sequence[PlanarTrack],
    fixed: Sequence[FixedPath],
    gaze_targets: F64,
    duration: float,
    seed: tuple[int, ...],
) -> list[SplinePath]:
    count = len(tracks[0].seconds)
    gaze_agents = [GazeAgent(t.xy, m.height) for t, m in zip(tracks, members, strict=True)]
    fixed_agents = [GazeAgent(_extended(p.xyz[:, :2], count), float(p.xyz[:, 2].mean())) for p in fixed]
    paths = []
    for i, (m, track) in enumerate(zip(members, tracks, strict=True)):
        rng = np.random.default_rng((*seed, i, 1))
        others = [s for k, s in enumerate(gaze_agents) if k != i] + fixed_agents
        if m.preferences.body_kind == "person":
            path = walk.headset_path(track, m.height, m.max_head_rate, gaze_targets, others, START_NS, rng)
        else:
            path = robot.imu_path(track, m.height, m.vibration, START_NS, rng)
        paths.append(replace(path, end_ns=START_NS + round(duration * 1e9)))
    return paths


def _keep_distance(
    members: Sequence[SimulatedAgent], paths: Sequence[SplinePath], fixed: Sequence[FixedPath]
) -> bool:
    """Return whether all keep the lesser of their two distances at all times."""
    bodies = [fixed_path(p, m.preferences.distance) for p, m in zip(paths, members, strict=True)]
    everyone = [*bodies, *fixed]
    for i, a in enumerate(bodies):
        for b in everyone[i + 1 :]:
            count = max(len(a.xyz), len(b.xyz))
            if min_distance(_extended(a.xyz, count), _extended(b.xyz, count)) < min(a.distance, b.distance):
                return False
    return True


def _extended(values: F64, count: int) -> F64:
    """Return the first `count` rows (count, D), the last one repeated where there are fewer."""
    return values[np.minimum(np.arange(count), len(values) - 1)]
