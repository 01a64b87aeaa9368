"""The pose graphs of all maps, kept solved: the solver is told only what is new.

Every solution starts from the one before. It runs in one thread and needs no clock; what it costs:
docs/edge-map.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from share.config import GraphConfig
from share.mapping.graph.covariance import covariances
from share.mapping.graph.edges import Edges
from share.mapping.graph.optimiser import chain_order, minimise
from share.mapping.graph.updates import Change, Solution
from share.types import F64, I64


class Solver:
    """All poses, by number, and the edges between them."""

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        self.clear()

    def clear(self) -> None:
        """Know nothing any more."""
        nothing = Change.of({})
        self._numbers = nothing.numbers  # rising
        self._poses, self._plumb = nothing.poses, nothing.plumb
        self._ids, self._edges = nothing.edge_ids, _edges_of(nothing)  # their ends are numbers

    def __len__(self) -> int:
        return len(self._numbers)

    def update(self, change: Change) -> None:
        """Take news in. Raises ValueError, and stays as it was, if an edge or a pose that should go is
        not known, if an edge's id is known already, or if an end of it is not there."""
        numbers, poses, plumb = self._poses_after(change)
        ids, edges = self._edges_after(change, numbers)
        self._numbers, self._poses, self._plumb = numbers, poses, plumb
        self._ids, self._edges = ids, edges

    def solve(self, anchor: int, wanted: Sequence[int] = ()) -> Solution:
        """The most likely poses of all that is joined to pose `anchor`, which stays where it is and, where
        plumb lines are known, turns only to be upright.

        wanted: the poses whose covariances are asked for. What cannot be solved comes back as it
        was, with the reason. Deterministic. Raises ValueError if the anchor is not known or a
        wanted pose is not joined to it.
        """
        part, touching = self._part(anchor)
        numbers, edges = self._numbers[part], self._edges[touching]
        goals = _places(numbers, np.array(wanted, np.int64), f"joined to {anchor}")
        local = edges.between(np.searchsorted(numbers, edges.a), np.searchsorted(numbers, edges.b))
        order = chain_order(len(part), local[~local.is_loop])
        rank = np.argsort(order)
        chained = local.between(rank[local.a], rank[local.b])
        held = int(rank[np.searchsorted(numbers, anchor)])
        plumb = self._plumb[part][order]
        minimum = minimise(self._poses[part][order], plumb, chained, held, self._config)
        poses = minimum.poses[rank]
        if minimum.reason:
            goals = goals[:0]
        else:
            self._poses = _replaced(self._poses, part, poses)
        return Solution(
            numbers,
            poses,
            covariances(chained, plumb, minimum, held, rank[goals], self._config),
            self._ids[touching][edges.is_loop],
            minimum.at.chi2[edges.is_loop],
            minimum.iterations,
            minimum.reason,
        )

    def _part(self, anchor: int) -> tuple[I64, I64]:
        """Places of the poses that are joined to `anchor`, and of the edges between them."""
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import connected_components

        at = _places(self._numbers, np.array([anchor]), "known")[0]
        a, b = np.searchsorted(self._numbers, self._edges.a), np.searchsorted(self._numbers, self._edges.b)
        n = len(self._numbers)
        graph = csr_array((np.ones(len(a)), (a, b)), shape=(n, n))
        label = connected_components(graph, directed=False)[1]
        return np.flatnonzero(label == label[at]), np.flatnonzero(label[a] == label[at])

    def _poses_after(self, change: Change) -> tuple[I64, F64, F64]:
        kept = np.ones(len(self._numbers), bool)
        kept[_places(self._numbers, change.gone_poses, "known")] = False
        numbers = np.union1d(self._numbers[kept], change.numbers)
        poses, plumb = np.empty((len(numbers), 4, 4)), np.empty((len(numbers), 3))
        for known, at, of_them in (
            (self._numbers[kept], self._poses[kept], self._plumb[kept]),
            (change.numbers, change.poses, change.plumb),
        ):
            places = np.searchsorted(numbers, known)
            poses[places], plumb[places] = at, of_them
        return numbers, poses, plumb

    def _edges_after(self, change: Change, numbers: I64) -> tuple[I64, Edges]:
        _require(np.isin(change.gone_edges, self._ids), change.gone_edges, "edge", "is not known")
        gone = np.isin(self._ids, change.gone_edges)
        for end in (self._edges.a, self._edges.b):
            gone |= np.isin(end, change.gone_poses)
        ids = np.concatenate([self._ids[~gone], change.edge_ids])
        once = np.unique(ids, return_counts=True)
        _require(once[1] == 1, once[0], "edge", "is known already")
        _places(numbers, change.ends.ravel(), "known")
        return ids, self._edges[~gone].with_those(_edges_of(change))


def _edges_of(change: Change) -> Edges:
    return Edges.measured(change.ends, change.measured, change.covs, change.is_loop)


def _replaced(poses: F64, places: I64, new: F64) -> F64:
    poses = poses.copy()
    poses[places] = new
    return poses


def _places(numbers: I64, wanted: I64, what: str) -> I64:
    """Where `wanted` are in `numbers`, which rise. Raises ValueError if one is not there."""
    _require(np.isin(wanted, numbers), wanted, "pose", f"is not {what}")
    return np.searchsorted(numbers, wanted)


def _require(fine: Any, which: I64, kind: str, why: str) -> None:
    if not np.all(fine):
        raise ValueError(f"{kind} {which[~fine][0]} {why}")
