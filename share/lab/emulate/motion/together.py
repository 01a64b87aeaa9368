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
from share.lab.emulate.motion.route import Network, Way, arc_length
from share.lab.emulate.motion.schedule import STEP_S, Limits, Other, schedule, speed_limit
from share.lab.emulate.motion.track import KNOT_S, Track
from share.types import F64

PEOPLE_M, ROBOT_M = 0.6, 0.5  # no nearer than this at any time
_SPARE_M = 0.17  # heads lean and schedules are smoothed: plan for this much more
_TOURS = 12  # that each agent tries before all begin anew
_TOUCH_M = 0.05  # of the grid's own error
_BEGIN_S = 1.2  # the smoothing in time lets motion begin this much sooner
_PAUSE_S = (1.5, 4.5)
_NEARLY = 0.15  # relative; the rest is made good afterwards
_EASE = 1.08  # bends take their time: hope for this much more than is to be gone
_BRANCHES: dict[str, ModuleType] = {"person": walk, "robot": robot}


@dataclass(frozen=True)
class Wish:
    """How one would like to move. look: `person` or `robot`. speed: m/s. pauses: a minute. gone: m to
    have gone at the end, None for as many as it takes. near: (x, y) m, where to start."""

    look: str
    speed: float
    pauses: float
    gone: float | None = None
    near: tuple[float, float] | None = None

    @property
    def limits(self) -> Limits:
        """Of its body."""
        found: Limits = _BRANCHES[self.look].limits(self.speed)
        return found

    @property
    def distance(self) -> float:
        """Least distance (m) that others keep from it."""
        return PEOPLE_M if self.look == "person" else ROBOT_M


class Ground:
    """One floor and what bodies of each look can reach of it: made once, used for every attempt."""

    def __init__(self, floor: Floor) -> None:
        self.floor = floor
        self._networks: dict[str, Network] = {}

    def network(self, look: str) -> Network:
        """Where a body can be."""
        if look not in self._networks:
            self._networks[look] = Network(self.floor, _BRANCHES[look].RADIUS)
        return self._networks[look]


@dataclass(frozen=True, eq=False)
class Course:
    """A way, the speed limit (N,) m/s on it, and the speeds (T,) m/s one would like in each step."""

    look: str
    way: Way
    most: F64
    wanted: F64

    def track(
        self, ground: Ground, taken: Sequence[Other], duration: float, gone: float | None
    ) -> Track | None:
        """The motion on it that keeps off `taken`, and goes `gone` m; None if there is none."""
        branch = _BRANCHES[self.look]
        steps = schedule(self.way, self.most, self.wanted, taken, gone)
        if steps is None:
            return None
        track: Track = branch.track_of(self.way, steps, duration)
        fits = ground.floor.at(track.xy[::20]).min() >= branch.RADIUS - _TOUCH_M
        return track if fits else None


def move(
    ground: Ground, wish: Wish, taken: Sequence[Other], duration: float, seed: tuple[int, ...]
) -> tuple[Course, Track] | None:
    """The motion of one that keeps off `taken` for `duration` s; None if no tour does."""
    for attempt in range(_TOURS):
        course = _course(ground, wish, duration, np.random.default_rng((*seed, attempt)))
        track = course.track(ground, taken, duration, wish.gone) if course else None
        if course and track and _far_enough(track, wish.gone):
            return course, track
    return None


def _far_enough(track: Track, gone: float | None) -> bool:
    """Whether a track comes near to the length asked for: others may push one on or hold one up."""
    return gone is None or abs(arc_length(track.xy[::10])[-1] / gone - 1) < _NEARLY


def _course(ground: Ground, wish: Wish, duration: float, rng: np.random.Generator) -> Course | None:
    branch = _BRANCHES[wish.look]
    wanted = _wanted(wish, branch.STILL_S, duration, rng)
    longest = 1.3 * max(wanted.sum() * STEP_S, wish.gone or 0.0) + 1.0
    start = None if wish.near is None else np.array(wish.near)
    legs = ground.network(wish.look).tour(longest, rng, start)
    if not legs:
        return None
    way: Way = branch.way_of(ground.floor, legs)
    return Course(wish.look, way, speed_limit(way, wish.limits), wanted)


def obstacle(xy: F64, distance: float) -> Other:
    """What others keep off: places xy (M, 2) m every KNOT_S."""
    return Other(xy[:: round(STEP_S / 2 / KNOT_S)], distance + _SPARE_M)


def nearest(a: F64, b: F64) -> float:
    """Least horizontal distance (m) of two that are at a (N, 2 or 3) and b (N, 2 or 3) at the same times."""
    return float(np.linalg.norm(a[:, :2] - b[:, :2], axis=1).min())


def _wanted(wish: Wish, still: float, duration: float, rng: np.random.Generator) -> F64:
    """Speed (T,) m/s in each step of the schedule: standing at first, pauses now and then, and as many
    more as leave about `wish.gone` metres."""
    steps = int(np.ceil(duration / STEP_S)) + 1
    t = (np.arange(steps) + 0.5) * STEP_S
    speed = np.where(t < still + _BEGIN_S, 0.0, wish.speed)
    count = int(np.floor(wish.pauses * duration / 60 + rng.random()))
    while count > 0 or (wish.gone is not None and speed.sum() * STEP_S > _EASE * wish.gone):
        at, took = rng.uniform(min(still + 3, duration / 2), duration), rng.uniform(*_PAUSE_S)
        speed[(t > at) & (t < at + took)] = 0.0
        count -= 1
    return speed
