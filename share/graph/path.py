"""How well is one pose known from another? By the surest way through the graph between them.

The covariance along any one path is an upper bound of what the whole graph knows, and it costs no
factorisation. It is what a new loop has to agree with.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from share.geometry import se3
from share.graph.posegraph import Edge
from share.graph.ways import Ways
from share.types import F64, I64

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
