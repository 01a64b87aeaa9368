"""The ways of least cost through a graph, from one pose to many (Dijkstra 1959)."""

from __future__ import annotations

import numpy as np

from share.types import F64, I64


class Ways:
    """n poses and E edges between them: ends a, b (E,), cost (E,) each, to be walked either way."""

    def __init__(self, n: int, a: I64, b: I64, cost: F64) -> None:
        from scipy.sparse import csr_array

        key = np.minimum(a, b) * n + np.maximum(a, b)
        order = np.lexsort((cost, key))
        cheapest = np.ones(len(key), bool)  # of parallel ones
        cheapest[1:] = key[order[1:]] != key[order[:-1]]
        self._edge = order[cheapest]
        self._key = key[self._edge]
        self._n = n
        a, b, cost = a[self._edge], b[self._edge], np.maximum(cost[self._edge], 1e-300)
        ends = np.concatenate([a, b]), np.concatenate([b, a])
        self._graph = csr_array((np.concatenate([cost, cost]), ends), shape=(n, n))

    def before(self, start: int) -> I64:
        """The pose before each (n,) on the way to it from `start`; negative at the start and out of reach."""
        from scipy.sparse.csgraph import dijkstra

        return np.asarray(dijkstra(self._graph, indices=start, return_predecessors=True)[1], np.int64)

    def edges(self, u: I64, v: I64) -> I64:
        """Index (K,) of the cheapest edge between each u and v, which are neighbours."""
        return self._edge[np.searchsorted(self._key, np.minimum(u, v) * self._n + np.maximum(u, v))]


def on_the_way(before: I64, goals: I64) -> I64:
    """All poses on the ways to `goals`, these included, the start not; rising."""
    met = np.zeros(len(before), bool)
    here = goals[before[goals] >= 0]
    while len(here):
        met[here] = True
        here = before[here]
        here = here[(before[here] >= 0) & ~met[here]]
    return np.flatnonzero(met)
