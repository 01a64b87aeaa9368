"""Schedules along a route: near the target speed, slow in bends, never where another agent is.

Path-velocity decomposition (Kant & Zucker, IJRR 5(3), 1986): the route is fixed, and the others are forbidden
regions in the plane of time and distance along it. Dynamic programming finds the cheapest monotone line
through that plane; the cost is the squared deviation from the target speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.lab.emulate.motion.route import Route
from share.types import F64

STEP_S = 0.2
_SPEED_LEVELS = 14  # speeds of the search, besides standing
_SUBSTEPS = 2  # collision checks per step
_FINE_S = 0.05
_SMOOTHING_S = 0.4  # sigma of smoothing in time: a step of 1 m/s becomes 1 m/s^2 at most


@dataclass(frozen=True)
class MotionLimits:
    """Limits of a body. max_speed: m/s. max_rotation_rate: rad/s. lateral_acceleration: m/s^2 in a bend.
    acceleration: m/s^2 along the route, either sign."""

    max_speed: float
    max_rotation_rate: float
    lateral_acceleration: float
    acceleration: float


@dataclass(frozen=True, eq=False)
class MovingObstacle:
    """Keep `distance` m away from xy (K, 2) m every STEP_S / 2 from the start; the last place holds
    afterwards."""

    xy: F64
    distance: float


def speed_limit(route: Route, limits: MotionLimits) -> F64:
    """Return the speed limit (N,) m/s at each point of the route that also leaves room to brake."""
    bend = np.abs(route.curvature) + 1e-9
    v: F64 = np.minimum(
        limits.max_speed,
        np.minimum(limits.max_rotation_rate / bend, np.sqrt(limits.lateral_acceleration / bend)),
    )
    v = np.maximum(v, 0.05)
    gain = 2 * limits.acceleration * np.diff(route.distance)
    for i in range(1, len(v)):
        v[i] = min(v[i], np.sqrt(v[i - 1] ** 2 + gain[i - 1]))
    for i in range(len(v) - 2, -1, -1):
        v[i] = min(v[i], np.sqrt(v[i + 1] ** 2 + gain[i]))
    return v


def plan_schedule(
    route: Route,
    speed_limits: F64,
    target_speeds: F64,
    others: Sequence[MovingObstacle] = (),
    end: float | None = None,
) -> F64 | None:
    """Return the distance (T,) m along the route at the instants k * STEP_S, T = len(target_speeds) + 1; None
    if the others block it.

    speed_limits (N,) m/s: at each point of the route; target_speeds (T - 1,) m/s: of each step. end: distance
    to reach at the end, m, as nearly as possible.
    """
    cell = float(speed_limits.max()) * STEP_S / _SPEED_LEVELS
    place = np.arange(int(route.distance[-1] / cell) + 1) * cell
    limit = np.interp(place, route.distance, speed_limits)
    xy = np.stack([np.interp(place, route.distance, route.xy[:, k]) for k in range(2)], axis=1)
    speeds = np.arange(_SPEED_LEVELS + 1) * (cell / STEP_S)
    is_forbidden = np.where(speeds[:, None] <= np.maximum(limit, speeds[1] + 1e-9), 0.0, np.inf)
    cost, back = np.full(len(place), np.inf), np.zeros((len(target_speeds), len(place)), np.int8)
    cost[0], first, last = 0.0, 0, 1  # reachable by now: place[first:last]
    for k, target_speed in enumerate(target_speeds):
        reach = min(last + _SPEED_LEVELS, len(place))
        costs = np.full((len(speeds), reach - first), np.inf)
        reachable = slice(first, last)
        price = (
            (speeds[:, None] - np.minimum(target_speed, limit[reachable])) ** 2
            + is_forbidden[:, reachable]
            + cost[reachable]
        )
        for j in range(len(speeds)):
            count = min(last, reach - j) - first
            costs[j, j : j + max(count, 0)] = price[j, : max(count, 0)]
        back[k, first:reach] = np.argmin(costs, axis=0)
        now = np.min(costs, axis=0)
        now[_blocked_mask(xy[first:reach], others, k + 1)] = np.inf
        cost[first:reach] = now
        finite = np.flatnonzero(np.isfinite(now))
        if not len(finite):
            return None
        first, last = first + int(finite[0]), first + int(finite[-1]) + 1
        cost[:first] = np.inf
    total = cost + (0 if end is None else 30 * (place - end) ** 2)
    return _backtrack(back, int(np.argmin(total))) * cell


def smooth_schedule(steps: F64, seconds: F64) -> F64:
    """Return the distance (M,) m along the route at `seconds` (M,) of a schedule by `plan_schedule`, smooth
    in time."""
    from scipy.interpolate import make_interp_spline
    from scipy.ndimage import gaussian_filter1d

    fine = np.arange(0, (len(steps) - 1) * STEP_S + _FINE_S / 2, _FINE_S)
    rough = np.interp(fine, np.arange(len(steps)) * STEP_S, steps)
    soft = gaussian_filter1d(rough, _SMOOTHING_S / _FINE_S, mode="nearest")
    out: F64 = make_interp_spline(fine, soft, k=5)(seconds)
    return out.clip(steps[0], steps[-1])


def _blocked_mask(xy: F64, others: Sequence[MovingObstacle], step: int) -> np.ndarray:
    out = np.zeros(len(xy), bool)
    for other in others:
        for k in range(_SUBSTEPS * (step - 1) + 1, _SUBSTEPS * step + 1):
            position = other.xy[min(k, len(other.xy) - 1)]
            out |= ((xy - position) ** 2).sum(axis=1) < other.distance**2
    return out


def _backtrack(back: np.ndarray, end: int) -> F64:
    places = [end]
    for row in back[::-1]:
        places.append(places[-1] - int(row[places[-1]]))
    return np.array(places[::-1], float)
