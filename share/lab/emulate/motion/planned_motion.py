"""Plan routes and schedules of several agents on one floor, each keeping off those planned before.

An agent that finds no schedule tries other tours; if none works, all are planned again with another seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from share.lab.emulate.motion import robot, walk
from share.lab.emulate.motion.floor import Floor
from share.lab.emulate.motion.route import FloorGraph, Route, arc_length
from share.lab.emulate.motion.schedule import STEP_S, MotionLimits, MovingObstacle, plan_schedule, speed_limit
from share.lab.emulate.motion.track import KNOT_S, PlanarTrack
from share.types import F64

PEOPLE_M, ROBOT_M = 0.6, 0.5  # least distance from others at any time
_SPARE_DISTANCE_M = 0.17  # added to distances in planning, for leaning heads and smoothed schedules
_MAX_TOURS = 12  # per agent, before all are planned again
_GRID_TOLERANCE_M = 0.05  # of the grid
_START_DELAY_S = 1.2  # smoothing in time lets motion begin earlier by this
_PAUSE_S = (1.5, 4.5)
_LENGTH_TOLERANCE = 0.15  # relative; the rest is corrected later
_LENGTH_RESERVE = 1.08  # planned length over the wanted one, for time lost in bends
_BODY_MODULES: dict[str, ModuleType] = {"person": walk, "robot": robot}


@dataclass(frozen=True)
class MotionPreferences:
    """body_kind: `person` or `robot`. speed: m/s. length: m to travel, None for any. start_near: (x, y) m,
    where to start."""

    body_kind: str
    speed: float
    pauses_per_minute: float
    length: float | None = None
    start_near: tuple[float, float] | None = None

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
    return length is None or abs(arc_length(track.xy[::10])[-1] / length - 1) < _LENGTH_TOLERANCE


def _plan_route(
    ground: FloorGraphs, preferences: MotionPreferences, duration: float, rng: np.random.Generator
) -> PlannedRoute | None:
    body = _BODY_MODULES[preferences.body_kind]
    target_speeds = _target_speeds(preferences, body.INITIAL_STILL_S, duration, rng)
    longest = 1.3 * max(target_speeds.sum() * STEP_S, preferences.length or 0.0) + 1.0
    start = None if preferences.start_near is None else np.array(preferences.start_near)
    legs = ground.graph_of(preferences.body_kind).random_tour(longest, rng, start)
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
