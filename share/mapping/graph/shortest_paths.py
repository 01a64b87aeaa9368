"""Shortest paths in a graph whose edges come and go."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from share.types import F64, I64

_MAX_COST = 1e300  # a cost that no path has; below that of a removed edge
_MAX_REMOVED_SHARE = 0.1  # share of removed edges in the arrays
_REACH_FACTOR = 8.0  # factor on the cost up to which a search goes, until it reaches its goals


class ShortestPaths:
    """Shortest paths (Dijkstra 1959) among n poses with E undirected edges: ends a, b (E,), cost (E,).

    An edge is known by its index; of the first ones it is their position.
    """

    def __init__(self, n: int, a: I64, b: I64, cost: F64) -> None:
        # Edges in both directions, sorted by start:
        self._starts, self._targets = np.zeros(n + 1, np.int32), np.zeros(0, np.int32)
        self._edge_index, self._cost = np.zeros(0, np.int64), np.zeros(0)
        self._removed_count = 0  # removed edges that are still in the arrays, at an infinite cost
        self._last_reach = _MAX_COST
        self.add(n, a, b, cost, np.arange(len(a)))

    def add(self, n: int, a: I64, b: I64, cost: F64, index: I64) -> None:
        """Add edges with these indices. n: number of poses with theirs."""
        target, both = np.concatenate([b, a]), np.concatenate([index, index])
        added, order = _by_start(n, np.concatenate([a, b]))
        new = target[order].astype(np.int32), both[order], _positive(np.concatenate([cost, cost])[order])
        if len(self._cost):
            starts = np.concatenate([self._starts, np.full(n + 1 - len(self._starts), self._starts[-1])])
            at = np.repeat(starts[1:], np.diff(added))  # behind those of the same start
            self._targets = np.insert(self._targets, at, new[0])
            self._edge_index = np.insert(self._edge_index, at, new[1])
            self._cost = np.insert(self._cost, at, new[2])
            added = starts + added
        else:
            self._targets, self._edge_index, self._cost = new
        self._set_starts(added)

    def remove(self, a: I64, b: I64, index: I64) -> None:
        """Remove the edges with these ends and indices: no path uses them, and when many are gone they leave
        the arrays."""
        for u, edge in [*zip(a, index, strict=True), *zip(b, index, strict=True)]:
            row = slice(self._starts[u], self._starts[u + 1])
            self._cost[row][self._edge_index[row] == edge] = np.inf
        self._graph.data = self._cost
        self._removed_count += 2 * len(index)
        if self._removed_count > _MAX_REMOVED_SHARE * len(self._cost):
            self._keep(np.isfinite(self._cost))
            self._removed_count = 0

    def _keep(self, is_left: NDArray[np.bool_]) -> None:
        before = np.concatenate([[0], np.cumsum(is_left)])
        self._targets, self._edge_index = self._targets[is_left], self._edge_index[is_left]
        self._cost = self._cost[is_left]
        self._set_starts(before[self._starts])

    def set_cost(self, cost: F64) -> None:
        """Change the cost (E,) of the edges, by index."""
        self._cost = _positive(cost[self._edge_index])
        self._graph.data = self._cost

    def predecessors(self, start: int) -> I64:
        """Return the pose before each (n,) on its path from `start`; negative for the start and unreachable
        ones.
        """
        from scipy.sparse.csgraph import dijkstra

        found = dijkstra(self._graph, indices=start, return_predecessors=True, limit=_MAX_COST)
        return np.asarray(found[1], np.int64)

    def predecessors_of(self, start: int, goals: I64) -> I64:
        """Return the same, negative too for poses that are further away than all goals.

        What is near is found at a cost that does not grow with the graph.
        """
        from scipy.sparse.csgraph import dijkstra

        reach, count = self._last_reach, 0
        while True:
            cost, before = dijkstra(self._graph, indices=start, return_predecessors=True, limit=reach)
            furthest = cost[goals].max(initial=0.0)
            if np.isfinite(furthest) or reach == _MAX_COST:
                break
            count, before_count = np.isfinite(cost).sum(), count
            # a goal may be unreachable
            searches_all = count == before_count or count > len(cost) / _REACH_FACTOR
            reach = _MAX_COST if searches_all else min(_REACH_FACTOR * reach, _MAX_COST)
        if np.isfinite(furthest) and furthest > 0:
            self._last_reach = 2 * float(furthest)
        return np.asarray(before, np.int64)

    def cheapest_edges(self, u: I64, v: I64) -> I64:
        """Return the index (K,) of the cheapest edge between each pair of neighbours u, v (K,)."""
        count = self._starts[u + 1] - self._starts[u]
        first = np.cumsum(count) - count
        all_of_u = np.arange(count.sum()) + np.repeat(self._starts[u] - first, count)
        arrives = self._targets[all_of_u] == np.repeat(v, count)
        fits, pair = all_of_u[arrives], np.repeat(np.arange(len(u)), count)[arrives]
        order = np.lexsort((self._cost[fits], pair))
        first_of_pair = order[np.searchsorted(pair[order], np.arange(len(u)))]
        return np.asarray(self._edge_index[fits[first_of_pair]], np.int64)

    def _set_starts(self, starts: I64) -> None:
        from scipy.sparse import csr_array

        self._starts, n = starts.astype(np.int32), len(starts) - 1
        self._graph = csr_array((self._cost, self._targets, self._starts), shape=(n, n))


def _by_start(n: int, start: I64) -> tuple[I64, I64]:
    """Sort edges by their start (E,), one of n poses: where those of each begin (n + 1,), and order (E,)."""
    from scipy.sparse import csc_array

    e = len(start)  # one column each, transposed: a counting sort
    leaving = csc_array((np.ones(e, np.int8), start, np.arange(e + 1)), shape=(n, e)).tocsr()
    return leaving.indptr, leaving.indices


def _positive(cost: F64) -> F64:
    return np.asarray(np.maximum(cost, 1e-300))  # zero would mean no edge


def poses_on_paths(predecessors: I64, goals: I64) -> I64:
    """Return all poses on the paths to `goals`, ascending; the goals are included, the start is not."""
    is_visited = np.zeros(len(predecessors), bool)
    frontier = goals[predecessors[goals] >= 0]
    while len(frontier):
        is_visited[frontier] = True
        frontier = predecessors[frontier]
        frontier = frontier[(predecessors[frontier] >= 0) & ~is_visited[frontier]]
    return np.flatnonzero(is_visited)
