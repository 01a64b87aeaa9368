"""`visit:` is a person who walks to given places: one after the other by the clock, or round and round.

Who goes by the clock has the right of way; who goes round and round keeps off the others, and waits where
they stand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from share.errors import UsageError
from share.lab.emulate.motion.crowd import PEOPLE_M, FixedPath, FloorGraphs, moving_obstacle
from share.lab.emulate.motion.route import Route, arc_length, headings, smooth_route
from share.lab.emulate.motion.schedule import STEP_S, MovingObstacle, plan_schedule, speed_limit
from share.lab.emulate.motion.spec import VisitSpec
from share.lab.emulate.motion.spline import SplinePath
from share.lab.emulate.motion.track import PlanarTrack
from share.lab.emulate.motion.walk import (
    INITIAL_STILL_S,
    RADIUS,
    GazeAgent,
    headset_path,
    motion_limits,
    track_on_route,
)
from share.lab.emulate.types import START_NS
from share.types import F64

_FINE_S = 0.02
_MIN_SPEED_M_S = 0.05  # on the last centimetres
_STOP_BEND = 1e3  # 1/m: it slows down there as if it turned on the spot
_SHORTEST_WAY_M = 0.3


def visiting_paths(
    ground: FloorGraphs,
    specs: Sequence[VisitSpec],
    heights: Sequence[float],
    fixed: Sequence[FixedPath],
    gaze_targets: F64,
    duration: float,
    seed: tuple[int, ...],
) -> list[SplinePath]:
    """Return the headsets' paths of `duration` s, in the specs' order. heights: of eyes, m. fixed: paths of
    others; gaze_targets (K, 3) m: what to look at. Raises UsageError where there is no way."""
    tracks: dict[int, PlanarTrack] = {}
    for i in sorted(range(len(specs)), key=lambda k: specs[k].stops[0][2] is None):
        obstacles = [*(one.xyz[:, :2] for one in fixed), *(track.xy for track in tracks.values())]
        tracks[i] = _visiting_track(ground, specs[i], obstacles, duration)
    people = [GazeAgent(tracks[i].xy, heights[i]) for i in range(len(specs))]
    paths = []
    for i, spec in enumerate(specs):
        rng, others = np.random.default_rng((*seed, i)), people[:i] + people[i + 1 :]
        path = headset_path(tracks[i], heights[i], spec.turns, gaze_targets, others, START_NS, rng)
        paths.append(replace(path, end_ns=START_NS + round(duration * 1e9)))
    return paths


def _visiting_track(
    ground: FloorGraphs, spec: VisitSpec, obstacles: Sequence[F64], duration: float
) -> PlanarTrack:
    """Return the trunk's motion. obstacles: places (M, 2) of others every KNOT_S, of whom only one without
    times keeps off."""
    if spec.stops[0][2] is not None:
        route, ends_m = _timed_route(ground, spec)
        return track_on_route(route, _timed_steps(route, ends_m, spec, duration), duration)
    others = [moving_obstacle(xy, PEOPLE_M) for xy in obstacles]
    for first in range(len(spec.stops)):
        if (track := _round_track(ground, spec, first, others, duration)) is not None:
            return track
    raise UsageError(
        "visit: the way round is blocked by those who stand on it; give other places or another seed"
    )


def _legs(ground: FloorGraphs, points: F64) -> list[F64]:
    graph = ground.graph_of("person")
    try:
        legs = [graph.way(a, b) for a, b in pairwise(points)]
    except ValueError as error:
        raise UsageError(f"visit: {error}") from None
    for leg, end in zip(legs, points[1:], strict=True):
        if len(leg) < 2 or arc_length(leg)[-1] < _SHORTEST_WAY_M:
            raise UsageError(f"visit: the place {end[0]:g} {end[1]:g} is that before; give places apart")
    return legs


def _timed_route(ground: FloorGraphs, spec: VisitSpec) -> tuple[Route, F64]:
    """Return the way, and where on it (K,), m, the places after the first are."""
    points = np.array([stop[:2] for stop in spec.stops])
    parts = [smooth_route(ground.floor, leg, RADIUS) for leg in _legs(ground, points)]
    xy = np.concatenate([parts[0], *(part[1:] for part in parts[1:])])
    distance, heading = arc_length(xy), headings(xy)
    ends = np.cumsum([len(part) - 1 for part in parts])
    bend = np.gradient(heading) / np.gradient(distance)
    bend[[0, *ends]] = _STOP_BEND
    return Route(xy, distance, heading, bend), distance[ends]


def _timed_steps(route: Route, ends_m: F64, spec: VisitSpec, duration: float) -> F64:
    """Return the distance (T,) along the way every STEP_S: it leaves each place at its time, and walks."""
    limits = np.minimum(speed_limit(route, motion_limits(spec.speed)), spec.speed)
    untils = [float(until_s or 0.0) for *_, until_s in spec.stops]
    here, number, fine = 0.0, 0, [0.0]
    for k in range(1, round((duration + STEP_S) / _FINE_S) + 1):
        is_leaving = number < len(ends_m) and k * _FINE_S >= untils[number]
        if is_leaving:
            speed = max(float(np.interp(here, route.distance, limits)), _MIN_SPEED_M_S)
            here = min(here + _FINE_S * speed, float(ends_m[number]))
            number += here >= ends_m[number]
        fine.append(here)
    return np.array(fine)[:: round(STEP_S / _FINE_S)]


def _round_track(
    ground: FloorGraphs, spec: VisitSpec, first: int, others: Sequence[MovingObstacle], duration: float
) -> PlanarTrack | None:
    """Return a walk round and round that begins at place number `first`; None where others block it."""
    once = np.roll(np.array([stop[:2] for stop in spec.stops]), -first, axis=0)
    legs = _legs(ground, np.concatenate([once, once[:1]]))
    rounds = int(np.ceil((spec.speed * duration + 1.0) / sum(arc_length(leg)[-1] for leg in legs))) + 1
    line = np.concatenate([legs[0], *(leg[1:] for leg in (legs * rounds)[1:])])
    xy = smooth_route(ground.floor, line, RADIUS)
    heading = headings(xy)
    route = Route(xy, arc_length(xy), heading, np.gradient(heading) / np.gradient(arc_length(xy)))
    seconds = (np.arange(int(np.ceil(duration / STEP_S)) + 1) + 0.5) * STEP_S
    targets = np.where(seconds < INITIAL_STILL_S, 0.0, spec.speed)
    steps = plan_schedule(route, speed_limit(route, motion_limits(spec.speed)), targets, others)
    return None if steps is None else track_on_route(route, steps, duration)
