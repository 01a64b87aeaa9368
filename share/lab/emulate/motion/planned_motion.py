"""Several agents on one floor at once: each finds a way and a schedule that keeps off those before it.

The first has the right of way. Who finds no way through tries other tours; where none of them helps,
all begin anew with another seed.
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

PEOPLE_M, ROBOT_M = 0.6, 0.5  # no nearer than this at any time
_SPARE_DISTANCE_M = 0.17  # heads lean and schedules are smoothed: plan for this much more
_MAX_TOURS = 12  # that each agent tries before all begin anew
_GRID_TOLERANCE_M = 0.05  # of the grid's own error
_START_DELAY_S = 1.2  # the smoothing in time lets motion begin this much sooner
_PAUSE_S = (1.5, 4.5)
_LENGTH_TOLERANCE = 0.15  # relative; the rest is made good afterwards
_LENGTH_RESERVE = 1.08  # bends take their time: hope for this much more than is to be gone
_BODY_MODULES: dict[str, ModuleType] = {"person": walk, "robot": robot}


@dataclass(frozen=True)
class MotionPreferences:
    """How one would like to move. look: `person` or `robot`. speed: m/s. pauses: a minute. gone: m to
    have gone at the end, None for as many as it takes. near: (x, y) m, where to start."""

    body_kind: str
    speed: float
    pauses_per_minute: float
    length: float | None = None
    start_near: tuple[float, float] | None = None

    @property
    def limits(self) -> MotionLimits:
        """Of its body."""
        found: MotionLimits = _BODY_MODULES[self.body_kind].motion_limits(self.speed)
        return found

    @property
    def distance(self) -> float:
        """Least distance (m) that others keep from it."""
        return PEOPLE_M if self.body_kind == "person" else ROBOT_M


class FloorGraphs:
    """One floor and what bodies of each look can reach of it: made once, used for every attempt."""

    def __init__(self, floor: Floor) -> None:
        self.floor = floor
        self._graphs: dict[str, FloorGraph] = {}

    def graph_of(self, body_kind: str) -> FloorGraph:
        """Where a body can be."""
        if body_kind not in self._graphs:
            self._graphs[body_kind] = FloorGraph(self.floor, _BODY_MODULES[body_kind].RADIUS)
        return self._graphs[body_kind]


@dataclass(frozen=True, eq=False)
class PlannedRoute:
    """A way, the speed limit (N,) m/s on it, and the speeds (T,) m/s one would like in each step."""

    body_kind: str
    route: Route
    speed_limits: F64
    target_speeds: F64

    def track(
        self, ground: FloorGraphs, obstacles: Sequence[MovingObstacle], duration: float, length: float | None
    ) -> PlanarTrack | None:
        """The motion on it that keeps off `obstacles`, and goes `length` m; None if there is none."""
        branch = _BODY_MODULES[self.body_kind]
        steps = plan_schedule(self.route, self.speed_limits, self.target_speeds, obstacles, length)
        if steps is None:
            return None
        track: PlanarTrack = branch.track_on_route(self.route, steps, duration)
        fits = ground.floor.clearance_at(track.xy[::20]).min() >= branch.RADIUS - _GRID_TOLERANCE_M
        return track if fits else None


def plan_motion(
    ground: FloorGraphs,
    preferences: MotionPreferences,
    obstacles: Sequence[MovingObstacle],
    duration: float,
    seed: tuple[int, ...],
) -> tuple[PlannedRoute, PlanarTrack] | None:
    """The motion of one that keeps off `obstacles` for `duration` s; None if no tour does."""
    for attempt in range(_MAX_TOURS):
        course = _plan_route(ground, preferences, duration, np.random.default_rng((*seed, attempt)))
        track = course.track(ground, obstacles, duration, preferences.length) if course else None
        if course and track and _has_length(track, preferences.length):
            return course, track
    return None


def _has_length(track: PlanarTrack, length: float | None) -> bool:
    """Whether a track comes near to the length asked for: others may push one on or hold one up."""
    return length is None or abs(arc_length(track.xy[::10])[-1] / length - 1) < _LENGTH_TOLERANCE


def _plan_route(
    ground: FloorGraphs, preferences: MotionPreferences, duration: float, rng: np.random.Generator
) -> PlannedRoute | None:
    branch = _BODY_MODULES[preferences.body_kind]
    target_speeds = _target_speeds(preferences, branch.INITIAL_STILL_S, duration, rng)
    longest = 1.3 * max(target_speeds.sum() * STEP_S, preferences.length or 0.0) + 1.0
    start = None if preferences.start_near is None else np.array(preferences.start_near)
    legs = ground.graph_of(preferences.body_kind).random_tour(longest, rng, start)
    if not legs:
        return None
    route: Route = branch.route_from_legs(ground.floor, legs)
    return PlannedRoute(preferences.body_kind, route, speed_limit(route, preferences.limits), target_speeds)


def moving_obstacle(xy: F64, distance: float) -> MovingObstacle:
    """What others keep off: places xy (M, 2) m every KNOT_S."""
    return MovingObstacle(xy[:: round(STEP_S / 2 / KNOT_S)], distance + _SPARE_DISTANCE_M)


def min_distance(a: F64, b: F64) -> float:
    """Least horizontal distance (m) of two that are at a (N, 2 or 3) and b (N, 2 or 3) at the same times."""
    return float(np.linalg.norm(a[:, :2] - b[:, :2], axis=1).min())


def _target_speeds(
    preferences: MotionPreferences, still: float, duration: float, rng: np.random.Generator
) -> F64:
    """Speed (T,) m/s in each step of the schedule: standing at first, pauses now and then, and as many
    more as leave about `wish.length` metres."""
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
