"""Ways over free floor: from place to place by shortest paths that keep off obstacles, then smoothed.

Cheapest paths by Dijkstra on the grid with 16 neighbours, the price of a metre rising near obstacles.
Smoothed as an elastic band (Quinlan & Khatib, ICRA 1993): diffusion along the way, repulsion where
the clearance is short. A band of k steps of diffusion at spacing h is smooth over about sqrt(k / 2) h.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from share.lab.emulate.motion.floor import Floor
from share.types import F64

Rng = np.random.Generator
SPACING = 0.05  # m between the points of a finished way
_BAND = 0.1  # m between those of a band
_COMFORT = 0.35  # m beyond the radius: nearer to things than that, a metre costs more
_NEIGHBOURS = [(1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)]
_LEG = (1.8, 6.0)  # m, how far the next place is
_PLACES = 40  # that are looked at before one is chosen


@dataclass(frozen=True, eq=False)
class Way:
    """A line to go along. xy (N, 2) m; gone (N,) m along it, rising; heading (N,) rad of the body, without
    jumps; bend (N,) 1/m: what its speed must be limited for."""

    xy: F64
    gone: F64
    heading: F64
    bend: F64


class Network:
    """The free floor for a body of `radius` m as a graph: the largest part that hangs together."""

    def __init__(self, floor: Floor, radius: float) -> None:
        from scipy.sparse.csgraph import connected_components

        self.floor, self.radius = floor, radius
        self._cells = np.argwhere(floor.clearance >= radius)
        graph = _graph(floor, self._cells, radius)
        _, part = connected_components(graph, directed=False)
        kept = np.flatnonzero(part == np.argmax(np.bincount(part))) if len(part) else np.zeros(0, int)
        self._cells, self._graph = self._cells[kept], graph[kept][:, kept]

    @property
    def places(self) -> F64:
        """(N, 2) m, where a body may be."""
        return np.asarray(self._cells * self.floor.step + self.floor.origin, np.float64)

    def tour(self, length: float, rng: Rng, start: F64 | None = None) -> list[F64]:
        """Legs (n, 2) m, end to end, from the place nearest to `start` (2,) m, at least `length` m in all;
        where they join they rather go on than back. Empty where there is nowhere to go."""
        if len(self._cells) < 2:
            return []
        at = int(rng.integers(len(self._cells))) if start is None else self.nearest(start)
        legs: list[F64] = []
        done, ahead = 0.0, None
        while done < length:
            leg, at = self._leg(at, ahead, rng)
            done += arc_length(leg)[-1]
            if done <= 0:
                return []
            ahead = leg[-1] - leg[max(-6, -len(leg))]
            legs.append(leg)
        return legs

    def nearest(self, xy: F64) -> int:
        """Number of the free place nearest to (2,) m."""
        return int(np.argmin(np.linalg.norm(self.places - xy, axis=1)))

    def _leg(self, at: int, ahead: F64 | None, rng: Rng) -> tuple[F64, int]:
        from scipy.sparse.csgraph import dijkstra

        _, before = dijkstra(self._graph, indices=at, return_predecessors=True)
        ends = rng.integers(len(self._cells), size=_PLACES)
        ends = ends[ends != at]
        ways = [self._way(before, at, int(end)) for end in ends]
        scores = [_score(way, ahead) + rng.uniform(0, 0.8) for way in ways]
        best = int(np.argmin(scores))
        return ways[best], int(ends[best])

    def _way(self, before: Any, at: int, end: int) -> F64:
        nodes = [end]
        while nodes[-1] != at:
            nodes.append(int(before[nodes[-1]]))
        return self.places[nodes[::-1]]


def smooth(floor: Floor, way: F64, radius: float, reach: float = 0.5) -> F64:
    """`way` (N, 2) m at equal spacing, smooth over about `reach` m, its clearance at least `radius` where
    it can be. Its ends stay."""
    p = resampled(way, _BAND)
    for _ in range(round(2 * (reach / _BAND) ** 2)):
        p[1:-1] += 0.5 * ((p[:-2] + p[2:]) / 2 - p[1:-1])
        p = _repelled(floor, p, radius)
    p = resampled(p, SPACING)
    for _ in range(12):
        p = _repelled(floor, p, radius)
        p[1:-1] += 0.5 * ((p[:-2] + p[2:]) / 2 - p[1:-1])
    return resampled(p, SPACING)


def arc_length(way: F64) -> F64:
    """Metres (N,) gone at each point (N, 2)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])


def resampled(way: F64, spacing: float) -> F64:
    """The same polyline with points about `spacing` m apart, both ends kept."""
    gone = arc_length(way)
    count = max(2, round(gone[-1] / spacing) + 1)
    at = np.linspace(0, gone[-1], count)
    return np.stack([np.interp(at, gone, way[:, k]) for k in range(2)], axis=1)


def headings(way: F64) -> F64:
    """Direction (N,) rad of travel at each point (N, 2), without jumps of 2 pi."""
    d = np.gradient(way, axis=0)
    return np.unwrap(np.arctan2(d[:, 1], d[:, 0]))


def _repelled(floor: Floor, p: F64, radius: float) -> F64:
    lack = (radius + 0.05 - floor.at(p)).clip(0, 0.1)
    lack[[0, -1]] = 0
    short = np.flatnonzero(lack)
    if len(short):
        p[short] += 0.6 * lack[short, None] * floor.away(p[short]).clip(-1, 1)
    return p


def _score(way: F64, ahead: F64 | None) -> float:
    """How little one would like to go this way next: 0 straight on and neither near nor far."""
    length = arc_length(way)[-1]
    cost = max(0.0, _LEG[0] - length) * 3 + max(0.0, length - _LEG[1])
    if ahead is not None:
        first = way[min(6, len(way) - 1)] - way[0]
        cost += 1.2 * _angle(first, ahead) ** 2
    return float(cost)


def _angle(a: F64, b: F64) -> float:
    return float(abs(np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b)))


def _graph(floor: Floor, cells: Any, radius: float) -> Any:
    from scipy.sparse import coo_array

    number = np.full(floor.clearance.shape, -1)
    number[tuple(cells.T)] = np.arange(len(cells))
    room = floor.clearance[tuple(cells.T)] - radius
    price = 1 + 3 * (1 - room / _COMFORT).clip(0, 1) ** 2
    rows, columns, costs = [], [], []
    for step in _NEIGHBOURS:
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
