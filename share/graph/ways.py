"""The ways of least cost through a graph, from one pose to many (Dijkstra 1959)."""

from __future__ import annotations

import numpy as np

from share.types import F64, I64


class Ways:
    """n poses and E edges between them: ends a, b (E,), cost (E,) each, to be walked either way."""

    def __init__(self, n: int, a: I64, b: I64, cost: F64) -> None:
        from scipy.sparse import csc_array, csr_array

        e = len(a)
        ends, others = np.concatenate([a, b]), np.concatenate([b, a])
        leaving = csc_array((np.ones(2 * e), ends, np.arange(2 * e + 1)), shape=(n, 2 * e)).tocsr()
        self._starts, way = leaving.indptr, leaving.indices  # sorted by where they leave, parallel ones kept
        self._to, self._edge = others[way], way % max(e, 1)
        self._cost = np.maximum(cost[self._edge], 1e-300)  # zero would be no edge
        self._graph = csr_array((self._cost, self._to, self._starts), shape=(n, n))

    def before(self, start: int) -> I64:
        """The pose before each (n,) on the way to it from `start`; negative at the start and out of reach."""
        from scipy.sparse.csgraph import dijkstra

        return np.asarray(dijkstra(self._graph, indices=start, return_predecessors=True)[1], np.int64)

    def edges(self, u: I64, v: I64) -> I64:
        """Index (K,) of the cheapest edge between each u and v, which are neighbours."""
        count = self._starts[u + 1] - self._starts[u]
        first = np.cumsum(count) - count
        all_of_u = np.arange(count.sum()) + np.repeat(self._starts[u] - first, count)
        arrives = self._to[all_of_u] == np.repeat(v, count)
        fits, pair = all_of_u[arrives], np.repeat(np.arange(len(u)), count)[arrives]
        order = np.lexsort((self._cost[fits], pair))
        first_of_pair = order[np.searchsorted(pair[order], np.arange(len(u)))]
        return np.asarray(self._edge[fits[first_of_pair]], np.int64)


def on_the_way(before: I64, goals: I64) -> I64:
    """All poses on the ways to `goals`, these included, the start not; rising."""
    met = np.zeros(len(before), bool)
    here = goals[before[goals] >= 0]
    while len(here):
        met[here] = True
        here = before[here]
        here = here[(before[here] >= 0) & ~met[here]]
    return np.flatnonzero(met)
