"""How well is one pose known from another? By the surest way through the graph between them.

The covariance along any one path is an upper bound of what the whole graph knows, and it costs no
factorisation. It is what a new loop has to agree with.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from share.config import GraphConfig
from share.geometry import se3
from share.mapping.graph.edges import Edge, Edges
from share.mapping.graph.edges import equations as plumb_equations
from share.mapping.graph.optimiser import Equations, Minimum, weighted_jacobians
from share.types import F64, I64

# ---- The ways of least cost through a graph, from one pose to many (Dijkstra 1959).


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


Placed = Sequence[F64] | Mapping[int, F64] | F64  # poses (4, 4) by number


class Roads:
    """The edges of a pose graph that grows and is thinned, by the poses that they touch."""

    def __init__(self) -> None:
        self._touching: Counter[int] = Counter()  # edges, by the number of a pose
        self._places: dict[int, int] = {}  # of the poses in the search, by number
        self._free: list[int] = []
        self._rows: dict[Edge, int] = {}
        self._edges: list[Edge] = []
        self._table = np.zeros((64, 3 + 16 + 36))  # places of a and b, spread, T_a_b, cov
        self._ways: Ways | None = None  # None once an edge has come or gone

    def add(self, edge: Edge) -> None:
        """Raises ValueError if it is here already."""
        if edge in self._rows:
            raise ValueError(f"edge {edge.a} - {edge.b} is here already")
        for end in (edge.a, edge.b):
            self._touching[end] += 1
            if end not in self._places:
                self._places[end] = self._free.pop() if self._free else len(self._places)
        row = self._rows[edge] = len(self._edges)
        self._edges.append(edge)
        if row == len(self._table):
            self._table = np.concatenate([self._table, np.zeros_like(self._table)])
        ends = self._places[edge.a], self._places[edge.b], edge.spread
        self._table[row] = np.concatenate([ends, edge.T_a_b.ravel(), edge.cov.ravel()])
        self._ways = None

    def remove(self, edge: Edge) -> None:
        """Raises KeyError if it is not here."""
        row, last = self._rows.pop(edge), self._edges.pop()
        if last is not edge:
            self._edges[row], self._rows[last] = last, row
            self._table[row] = self._table[len(self._edges)]
        for end in (edge.a, edge.b):
            self._touching[end] -= 1
            if not self._touching[end]:
                del self._touching[end]
                self._free.append(self._places.pop(end))
        self._ways = None

    def known_from(self, start: int, goals: Sequence[int], poses: Placed) -> list[F64 | None]:
        """Covariance (6, 6) of T_start_goal for each goal along the surest path from `start` to it, each
        step laid along the current `poses`; None where there is no path. One search serves all."""
        if start not in self._places:
            return [np.zeros((6, 6)) if goal == start else None for goal in goals]
        before = self._search().before(self._places[start])
        paths = [self._path(before, start, goal) for goal in goals]
        met = np.array(sorted({place for path in paths for place in path or ()}), np.int64)
        steps = self._steps(before[met], met, start, poses)
        known = [i for i, path in enumerate(paths) if path is not None]
        sums = [steps[np.searchsorted(met, paths[i] or [])].sum(0) for i in known]
        out: list[F64 | None] = [None] * len(goals)
        if known:  # from perturbing `start` to perturbing the goal
            there = np.array([poses[goals[i]] for i in known])
            covs = se3.inverse_cov(se3.inverse(there) @ poses[start], np.array(sums))
            for i, cov in zip(known, covs, strict=True):
                out[i] = cov
        return out

    def _search(self) -> Ways:
        if self._ways is None:
            a, b, spread = self._table[: len(self._edges), :3].T
            size = len(self._places) + len(self._free)
            self._ways = Ways(size, a.astype(np.int64), b.astype(np.int64), spread)
        return self._ways

    def _path(self, before: I64, start: int, goal: int) -> list[int] | None:
        """Places on the way from `goal` back to `start`, the latter left out."""
        here, home = self._places.get(goal, -1), self._places[start]
        path: list[int] = []
        while here != home:
            if here < 0:
                return None
            path.append(here)
            here = int(before[here])
        return path

    def _steps(self, before: I64, met: I64, start: int, poses: Placed) -> F64:
        """Covariances (K, 6, 6) of the steps to places `met` from those before, perturbing T_start_start."""
        rows = self._search().edges(before, met)
        table = self._table[rows]
        onward = table[:, 1] == met
        walked = zip([self._edges[row] for row in rows], onward, strict=True)
        ends = [edge.b if ahead else edge.a for edge, ahead in walked]
        T_a_b, cov = table[:, 3:19].reshape(-1, 4, 4), table[:, 19:].reshape(-1, 6, 6)
        cov = np.where(onward[:, None, None], cov, se3.inverse_cov(T_a_b, cov))
        there = np.array([poses[end] for end in ends]).reshape(-1, 4, 4)
        return se3.inverse_cov(se3.inverse(poses[start]) @ there, cov)


# ---- How well poses are known from one of them: an upper bound that hardly exceeds the truth.
#
# The exact covariance costs a factorisation of the whole graph. But what is left out of a graph can only have
# told more, so the covariance in a part of it is an upper bound. The part that says most is that along the
# surest ways: once found, their edges are made dearer, and the next surest ways are added, until there are
# enough edges.

_LEAST_WEIGHT = 1e-9  # of a loop that all else speaks against, so that it can be divided by
_UNKNOWN = 1e6 * np.eye(6)


def covariances(edges: Edges, plumb: F64, at: Minimum, anchor: int, wanted: I64, config: GraphConfig) -> F64:
    """Covariances (K, 6, 6) of `wanted` (K,) of n poses relative to `anchor`, right perturbation.

    plumb (n, 3): see `share.mapping.graph.edges`; where there are any, tilts are relative to gravity.

    Every wanted pose must be joined to the anchor. Where edges differ so much in certainty (beyond some
    16 orders of magnitude) that nothing can be told, a sigma of 1000 rad and m says so.
    """
    n, out = len(plumb), np.zeros((len(wanted), 6, 6))
    free = np.flatnonzero(wanted != anchor)
    if not len(free):
        return out
    weights = np.maximum(at.weights, _LEAST_WEIGHT)
    part = _surest(n, edges, edges.spread / weights, anchor, wanted[free], config)
    poses = np.unique(np.concatenate([edges.a[part], edges.b[part]]))
    inside = edges[part].between(*(np.searchsorted(poses, end[part]) for end in (edges.a, edges.b)))
    equations = Equations(len(poses), inside, int(np.searchsorted(poses, anchor)), at.free)
    J = weighted_jacobians(at.at[part], weights[part], inside)
    own = plumb_equations(at.poses[poses], plumb[poses])
    out[free] = _blocks_of_inverse(equations.information(J, own), np.searchsorted(poses, wanted[free]))
    return out


def _surest(n: int, edges: Edges, cost: F64, anchor: int, wanted: I64, config: GraphConfig) -> I64:
    """Indices of the edges on the surest ways from the anchor to the wanted poses."""
    used, dear = np.zeros(len(edges), bool), cost.copy()
    for _ in range(config.covariance_rounds):
        ways = Ways(n, edges.a, edges.b, dear)
        before = ways.before(anchor)
        met = on_the_way(before, wanted)
        walked = ways.edges(before[met], met)
        used[walked] = True
        dear[walked] += 2 * cost[walked]
        if used.sum() >= config.covariance_edges:
            break
    return np.flatnonzero(used)


def _blocks_of_inverse(information: Any, wanted: I64) -> F64:
    """Those on the diagonal (K, 6, 6)."""
    from scipy.sparse.linalg import splu

    symmetric = {"SymmetricMode": True}
    factor = splu(information, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
    rows = 6 * wanted[:, None] + np.arange(6)
    k = len(wanted)
    right = np.zeros((information.shape[0], 6 * k))
    right[rows.ravel(), np.arange(6 * k)] = 1
    blocks = factor.solve(right)[rows.ravel()].reshape(k, 6, k, 6)
    blocks = blocks[np.arange(k), :, np.arange(k)]
    blocks = (blocks + np.swapaxes(blocks, 1, 2)) / 2
    told = np.linalg.eigvalsh(blocks)[:, 0] > 0
    return np.where(told[:, None, None], blocks, _UNKNOWN)
