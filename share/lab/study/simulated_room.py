"""The room of a simulated study: its free square, spots in it, and when a participant walks and calls.

A participant stands beside each spot, since the robot comes there. Its way is the same in all conditions, so
that what its headset sees is drawn once: it waits as long as the longer time-out, whether the robot comes or
not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.errors import UsageError
from share.lab.emulate.motion.crowd import PEOPLE_M, FloorGraphs
from share.lab.emulate.motion.robot import RADIUS
from share.lab.emulate.motion.route import Floor, arc_length
from share.lab.study.plan import SuccessRule
from share.lab.study.spots import Space
from share.robot.settings import CREATE3_SPEED_M_S
from share.types import F64

SPACE_M = 4.0  # the paper's square
SETUP_S = 25.0  # until the first walk: all walk about, and the robot is driven about
_SETUP_PLACES = 3
_SPOT_MARGIN_M, _APART_M = 0.6, 0.8
_SPOT_CLEARANCE_M = RADIUS + 0.25
_INNER_M = PEOPLE_M + 0.45  # from the researcher's path, which is the square's edge
_BESIDE_M = (0.8, 1.3)  # of a participant from its spot
_WALK_M_S, _SETTLE_S = 0.9, 1.5
_WALK_RESERVE = 1.6  # a walk takes up to so many times its length ÷ speed
_TRIES = 200


@dataclass(frozen=True)
class PlannedCall:
    """One call. t_s: session time; spot: its number in the plan, from 1; x, y: the cube, m; yaw: of the
    robot there, towards the participant, rad."""

    t_s: float
    spot: int
    x: float
    y: float
    yaw: float


@dataclass(frozen=True)
class ParticipantPlan:
    """places: x, y, m, and until when it stands there, s. calls: in their order. seconds: until its end."""

    places: tuple[tuple[float, float, float], ...]
    calls: tuple[PlannedCall, ...]
    seconds: float


def free_square(floor: Floor) -> Space:
    """Return the square of SPACE_M a side with the most floor that is free for a robot. Raises UsageError
    where less than half of any is."""
    free = (floor.clearance >= _SPOT_CLEARANCE_M).astype(np.int64)
    side = round(SPACE_M / floor.step)
    if min(free.shape) <= side:
        raise UsageError(f"the room is smaller than {SPACE_M:g} x {SPACE_M:g} m; give a larger one")
    sums = np.pad(free, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    counts = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    if counts.max() < side * side / 2:
        raise UsageError(f"the room has no {SPACE_M:g} x {SPACE_M:g} m of free floor; give another --seed")
    x, y = np.array(np.unravel_index(int(np.argmax(counts)), counts.shape)) * floor.step + floor.origin
    return Space(SPACE_M, SPACE_M, round(float(x), 3), round(float(y), 3))


def draw_clear_spots(ground: FloorGraphs, space: Space, count: int, rng: np.random.Generator) -> F64:
    """Return spots (count, 2), m, on free floor of the space, each with a place for a participant beside it.

    Raises UsageError where they do not fit.
    """
    places = ground.graph_of("robot").places
    fits = _within(places, space, _SPOT_MARGIN_M)
    fits = fits & (ground.floor.clearance_at(places) >= _SPOT_CLEARANCE_M)
    candidates = [xy for xy in places[fits] if len(_standing_places(ground, space, xy))]
    for _ in range(_TRIES):
        spots: list[F64] = []
        for k in rng.permutation(len(candidates)):
            if all(np.linalg.norm(candidates[k] - one) >= _APART_M for one in spots):
                spots.append(candidates[k])
                if len(spots) == count:
                    return np.array(spots).round(3)
    raise UsageError(
        f"{count} spots {_APART_M:g} m apart were not found in {space.width:g} x {space.depth:g} m; "
        "give fewer --goals or another --seed"
    )


def longest_way_m(spots: Sequence[tuple[float, float]]) -> float:
    """Return the longest straight way between two spots, m."""
    return max((math.dist(a, b) for a in spots for b in spots), default=0.0)


def plan_participant(
    ground: FloorGraphs,
    space: Space,
    spots: Sequence[tuple[float, float]],
    order: Sequence[int],
    rule: SuccessRule,
    rng: np.random.Generator,
) -> ParticipantPlan:
    """Return when a participant walks where, and calls. order: numbers of spots, from 1."""
    wait_s = rule.timeout_s + longest_way_m(spots) / CREATE3_SPEED_M_S
    graph = ground.graph_of("person")
    inner = graph.places[_within(graph.places, space, _INNER_M)]
    if len(inner) < _SETUP_PLACES:
        raise UsageError("the middle of the space is not free for a person; give another --seed")
    here = inner[int(rng.integers(len(inner)))]
    places: list[tuple[float, float, float]] = []
    for k in range(_SETUP_PLACES):
        places.append((*_rounded(here), SETUP_S * (k + 1) / (_SETUP_PLACES + 1)))
        far = inner[np.linalg.norm(inner - here, axis=1) > 0.8]
        here = far[int(rng.integers(len(far)))] if len(far) else inner[int(rng.integers(len(inner)))]
    places.append((*_rounded(here), SETUP_S))
    calls, leaves_s = [], SETUP_S
    for number in order:
        spot = np.array(spots[number - 1])
        beside = _standing_places(ground, space, spot)
        away = beside[np.linalg.norm(beside - here, axis=1) > 0.4]
        chosen = away if len(away) else beside
        there = chosen[int(rng.integers(len(chosen)))]
        way_m = float(arc_length(graph.way(here, there))[-1])
        call_s = round(leaves_s + _WALK_RESERVE * way_m / _WALK_M_S + _SETTLE_S, 1)
        leaves_s = round(call_s + wait_s, 1)
        yaw = math.atan2(*(there - spot)[::-1].tolist())
        calls.append(PlannedCall(call_s, number, float(spot[0]), float(spot[1]), yaw))
        places.append((*_rounded(there), leaves_s))
        here = there
    return ParticipantPlan(tuple(places), tuple(calls), leaves_s)


def participant_motion(name: str, plan: ParticipantPlan, height_m: float) -> str:
    """Return the motion of a participant for a session's recipe."""
    places = ";".join(f"{x:g} {y:g} {until_s:g}" for x, y, until_s in plan.places)
    return f"{name}=visit:{places},speed={_WALK_M_S:g},height={height_m:.2f}"


def researcher_motion(name: str, path: Sequence[tuple[float, float]], speed_m_s: float) -> str:
    """Return the motion of the researcher, round and round."""
    corners = path[:-1] if path[0] == path[-1] else path
    places = ";".join(f"{x:g} {y:g}" for x, y in corners)
    return f"{name}=visit:{places},speed={speed_m_s:g},height=1.7"


def _standing_places(ground: FloorGraphs, space: Space, spot: F64) -> F64:
    """Return places (N, 2) beside a spot, off the researcher's path."""
    places = ground.graph_of("person").places
    off_m = np.linalg.norm(places - spot, axis=1)
    fits = _within(places, space, _INNER_M) & (off_m >= _BESIDE_M[0]) & (off_m <= _BESIDE_M[1])
    out: F64 = places[fits]
    return out


def _within(places: F64, space: Space, margin_m: float) -> NDArray[np.bool_]:
    low = np.array([space.x, space.y]) + margin_m
    high = np.array([space.x + space.width, space.y + space.depth]) - margin_m
    out: NDArray[np.bool_] = np.all((places >= low) & (places <= high), axis=1)
    return out


def _rounded(xy: F64) -> tuple[float, float]:
    return round(float(xy[0]), 3), round(float(xy[1]), 3)
