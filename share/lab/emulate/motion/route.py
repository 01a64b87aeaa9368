"""Routes over free floor: shortest paths that keep off obstacles, smoothed.

The floor is a grid of distances from the nearest obstacle. Cheapest paths by Dijkstra with 16 neighbours; the
cost of a metre rises near obstacles. Smoothed as an elastic band (Quinlan & Khatib, ICRA 1993): diffusion
along the path, repulsion where the clearance is too small. k steps of diffusion at spacing h smooth over
about sqrt(k / 2) h.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from share.lab.emulate.world.occupancy import Occupancy
from share.types import F64

_MIN_OBSTACLE_M = 0.10  # lower steps are walked over
_MAX_OBSTACLE_M = 1.95  # higher beams are walked under
_VOXELS_PER_CELL = 2  # voxels of the occupancy per grid cell


@dataclass(frozen=True, eq=False)
class Floor:
    """clearance (X, Y) m at the places origin + (i, j) * step m: distance to the nearest obstacle between
    floor and head, 0 inside one."""

    clearance: F64
    step: float
    origin: float = 0.0

    def clearance_at(self, xy: F64) -> F64:
        """Return the clearance (N,) m at places (N, 2) m, bilinear; outside the grid that of its edge."""
        i, f = self._cells(xy)
        c = self.clearance
        low = c[i[:, 0], i[:, 1]] * (1 - f[:, 1]) + c[i[:, 0], i[:, 1] + 1] * f[:, 1]
        high = c[i[:, 0] + 1, i[:, 1]] * (1 - f[:, 1]) + c[i[:, 0] + 1, i[:, 1] + 1] * f[:, 1]
        out: F64 = low * (1 - f[:, 0]) + high * f[:, 0]
        return out

    def clearance_gradient(self, xy: F64) -> F64:
        """Return the gradient (N, 2) of the clearance."""
        h = self.step * np.eye(2)
        return np.stack([self.clearance_at(xy + d) - self.clearance_at(xy - d) for d in h], axis=1) / (
            2 * self.step
        )

    def _cells(self, xy: F64) -> tuple[np.ndarray, F64]:
        last_cell = np.array(self.clearance.shape) - 1
        place = ((np.asarray(xy) - self.origin) / self.step).clip(0, last_cell - 1e-9)
        cell = place.astype(int)
        return cell, place - cell


def floor_from_occupancy(occupancy: Occupancy) -> Floor:
    """Return the floor for people and robots alike: the space under a table is not free."""
    clearance, origin, step = occupancy.floor_clearance(_MIN_OBSTACLE_M, _MAX_OBSTACLE_M)
    grid = clearance[::_VOXELS_PER_CELL, ::_VOXELS_PER_CELL].astype(np.float64)
    return Floor(grid, step * _VOXELS_PER_CELL, float(origin[0]))


# Routes over the floor.

Rng = np.random.Generator
POINT_SPACING_M = 0.05  # between points of a finished route
_BAND_SPACING_M = 0.1  # between points of a band
_REACH_M = 0.5  # of smoothing along a route
_COMFORT_M = 0.35  # m beyond the radius; the cost of a metre rises below this clearance
_NEIGHBOUR_STEPS = [(1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)]
_LEG_RANGE_M = (1.8, 6.0)  # preferred length of a leg
_CANDIDATE_PLACES = 40  # drawn for each leg


@dataclass(frozen=True, eq=False)
class Route:
    """A line to follow. xy (N, 2) m; distance (N,) m along it, rising; heading (N,) rad of the body, without
    jumps; curvature (N,) 1/m, which limits the speed."""

    xy: F64
    distance: F64
    heading: F64
    curvature: F64


class FloorGraph:
    """The largest connected part of the free floor for a body of `radius` m, as a graph."""

    def __init__(self, floor: Floor, radius: float) -> None:
        from scipy.sparse.csgraph import connected_components

        self.floor, self.radius = floor, radius
        self._cells = np.argwhere(floor.clearance >= radius)
        graph = cell_graph(floor, self._cells, radius)
        _, part = connected_components(graph, directed=False)
        largest = np.flatnonzero(part == np.argmax(np.bincount(part))) if len(part) else np.zeros(0, int)
        self._cells, self._graph = self._cells[largest], graph[largest][:, largest]

    @property
    def places(self) -> F64:
        """Return places (N, 2) m where a body may be."""
        return np.asarray(self._cells * self.floor.step + self.floor.origin, np.float64)

    def random_tour(self, length: float, rng: Rng) -> list[F64]:
        """Return legs (n, 2) m, end to end, from a random place, at least `length` m in all, preferring to
        continue ahead where they join. Empty where there is no free place."""
        if len(self._cells) < 2:
            return []
        at = int(rng.integers(len(self._cells)))
        legs: list[F64] = []
        done, ahead = 0.0, None
        while done < length:
            leg, at = self._next_leg(at, ahead, rng)
            done += arc_length(leg)[-1]
            if done <= 0:
                return []
            ahead = leg[-1] - leg[max(-6, -len(leg))]
            legs.append(leg)
        return legs

    def way(self, start: F64, end: F64) -> F64:
        """Return the cheapest way (N, 2) m between the free places nearest to two places (2,).

        Raises ValueError where there is no free place.
        """
        from scipy.sparse.csgraph import dijkstra

        if not len(self._cells):
            raise ValueError("the floor has no free place")
        first, last = (int(np.argmin(np.linalg.norm(self.places - xy, axis=1))) for xy in (start, end))
        _, before = dijkstra(self._graph, indices=first, return_predecessors=True)
        return self._shortest_path(before, first, last)

    def _next_leg(self, start_cell: int, ahead: F64 | None, rng: Rng) -> tuple[F64, int]:
        from scipy.sparse.csgraph import dijkstra

        _, before = dijkstra(self._graph, indices=start_cell, return_predecessors=True)
        ends = rng.integers(len(self._cells), size=_CANDIDATE_PLACES)
        ends = ends[ends != start_cell]
        routes = [self._shortest_path(before, start_cell, int(end)) for end in ends]
        scores = [_leg_cost(route, ahead) + rng.uniform(0, 0.8) for route in routes]
        best = int(np.argmin(scores))
        return routes[best], int(ends[best])

    def _shortest_path(self, before: Any, start_cell: int, end: int) -> F64:
        nodes = [end]
        while nodes[-1] != start_cell:
            nodes.append(int(before[nodes[-1]]))
        return self.places[nodes[::-1]]


def smooth_route(floor: Floor, points: F64, radius: float) -> F64:
    """Return `points` (N, 2) m resampled and smoothed over about half a metre, with a clearance of at least
    `radius` where possible. The ends stay."""
    p = resample(points, _BAND_SPACING_M)
    for _ in range(round(2 * (_REACH_M / _BAND_SPACING_M) ** 2)):
        p[1:-1] += 0.5 * ((p[:-2] + p[2:]) / 2 - p[1:-1])
        p = _push_from_obstacles(floor, p, radius)
    p = resample(p, POINT_SPACING_M)
    for _ in range(12):
        p = _push_from_obstacles(floor, p, radius)
        p[1:-1] += 0.5 * ((p[:-2] + p[2:]) / 2 - p[1:-1])
    return resample(p, POINT_SPACING_M)


def arc_length(points: F64) -> F64:
    """Return the distance (N,) m along the polyline at each point (N, 2)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def resample(points: F64, spacing: float) -> F64:
    """Return the same polyline with points about `spacing` m apart, both ends kept."""
    distances = arc_length(points)
    count = max(2, round(distances[-1] / spacing) + 1)
    positions = np.linspace(0, distances[-1], count)
    return np.stack([np.interp(positions, distances, points[:, k]) for k in range(2)], axis=1)


def headings(points: F64) -> F64:
    """Return the direction of travel (N,) rad at each point (N, 2), without jumps of 2 pi."""
    d = np.gradient(points, axis=0)
    return np.unwrap(np.arctan2(d[:, 1], d[:, 0]))


def _push_from_obstacles(floor: Floor, p: F64, radius: float) -> F64:
    lack = (radius + 0.05 - floor.clearance_at(p)).clip(0, 0.1)
    lack[[0, -1]] = 0
    short = np.flatnonzero(lack)
    if len(short):
        p[short] += 0.6 * lack[short, None] * floor.clearance_gradient(p[short]).clip(-1, 1)
    return p


def _leg_cost(points: F64, ahead: F64 | None) -> float:
    """Return the cost of a leg: 0 for one straight ahead of a preferred length."""
    length = arc_length(points)[-1]
    cost = max(0.0, _LEG_RANGE_M[0] - length) * 3 + max(0.0, length - _LEG_RANGE_M[1])
    if ahead is not None:
        first = points[min(6, len(points) - 1)] - points[0]
        cost += 1.2 * _angle_between(first, ahead) ** 2
    return float(cost)


def _angle_between(a: F64, b: F64) -> float:
    return float(abs(np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b)))


def cell_graph(floor: Floor, cells: Any, radius: float) -> Any:
    """Return the ways between neighbouring cells (N, 2), indices into the floor's clearance, for a body of
    `radius` m: a sparse matrix (N, N) of costs, m."""
    from scipy.sparse import coo_array

    number = np.full(floor.clearance.shape, -1)
    number[tuple(cells.T)] = np.arange(len(cells))
    room = floor.clearance[tuple(cells.T)] - radius
    price = 1 + 3 * (1 - room / _COMFORT_M).clip(0, 1) ** 2
    rows, columns, costs = [], [], []
    for step in _NEIGHBOUR_STEPS:
        other = cells + step
        inside = ((other >= 0) & (other < number.shape)).all(axis=1)
        a = np.flatnonzero(inside)
        b = number[tuple(other[inside].T)]
        a, b = a[b >= 0], b[b >= 0]
        rows.append(a)
        columns.append(b)
        costs.append(float(np.hypot(*step)) * floor.step * (price[a] + price[b]) / 2)
    shape = (len(cells), len(cells))
    one_way = coo_array((np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))), shape)
    return (one_way + one_way.T).tocsr()
