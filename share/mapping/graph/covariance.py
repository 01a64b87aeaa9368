"""Relative covariances of poses, along the paths of least covariance through the graph.

The covariance along any path is an upper bound of that in the whole graph, without a factorisation. New loops
are tested against it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from share.geometry import se3
from share.mapping.graph.edges import EdgeArrays, PoseEdge
from share.mapping.graph.gravity import gravity_equations
from share.mapping.graph.optimiser import NormalEquations, OptimisedPoses, weighted_jacobians
from share.mapping.graph.shortest_paths import ShortestPaths, poses_on_paths
from share.types import F64, I64

PosesById = Sequence[F64] | Mapping[int, F64] | F64  # poses (4, 4) by id


class CovariancePaths:
    """Edges of a changing pose graph, and covariances along its shortest paths."""

    def __init__(self) -> None:
        self._degree: Counter[int] = Counter()  # number of edges of each pose
        self._slots: dict[int, int] = {}  # index of each pose in the search
        self._free_slots: list[int] = []
        self._rows: dict[PoseEdge, int] = {}
        self._edges: list[PoseEdge | None] = []  # by row; None: free
        self._free_rows: list[int] = []
        self._table = np.zeros((64, 3 + 16 + 36))  # slots of a and b, cov_trace, T_a_b, cov
        self._paths = ShortestPaths(0, np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
        # Rows that `_paths` does not know yet, and those it still has:
        self._added: dict[int, None] = {}
        self._removed: dict[int, tuple[int, int]] = {}  # with their slots

    def add(self, edge: PoseEdge) -> None:
        """Add an edge. Raises ValueError for a duplicate."""
        if edge in self._rows:
            raise ValueError(f"edge {edge.a} - {edge.b} was added before")
        for end in (edge.a, edge.b):
            self._degree[end] += 1
            if end not in self._slots:
                self._slots[end] = self._free_slots.pop() if self._free_slots else len(self._slots)
        if not self._free_rows:
            self._free_rows.append(len(self._edges))
            self._edges.append(None)
        row = self._rows[edge] = self._free_rows.pop()
        self._edges[row] = edge
        if row == len(self._table):
            self._table = np.concatenate([self._table, np.zeros_like(self._table)])
        ends = self._slots[edge.a], self._slots[edge.b], edge.cov_trace
        self._table[row] = np.concatenate([ends, edge.T_a_b.ravel(), edge.cov.ravel()])
        self._added[row] = None

    def remove(self, edge: PoseEdge) -> None:
        """Remove an edge. Raises KeyError if it is missing."""
        row, slots = self._rows.pop(edge), (self._slots[edge.a], self._slots[edge.b])
        self._edges[row] = None
        self._free_rows.append(row)
        for end in (edge.a, edge.b):
            self._degree[end] -= 1
            if not self._degree[end]:
                del self._degree[end]
                self._free_slots.append(self._slots.pop(end))
        if row in self._added:
            del self._added[row]
        else:
            self._removed[row] = slots

    def covariances_from(self, start: int, goals: Sequence[int], poses: PosesById) -> list[F64 | None]:
        """Covariance (6, 6) of T_start_goal for each goal, along the path of least covariance; or None.

        Each step is placed at the current `poses`. One search serves all goals.
        """
        if start not in self._slots:
            return [np.zeros((6, 6)) if goal == start else None for goal in goals]
        known_goals = [self._slots[goal] for goal in goals if goal in self._slots]
        predecessors = self._updated_paths().predecessors_of(
            self._slots[start], np.array(known_goals, np.int64)
        )
        paths = [self._path_slots(predecessors, start, goal) for goal in goals]
        visited = np.array(sorted({slot for path in paths for slot in path or ()}), np.int64)
        steps = self._step_covariances(predecessors[visited], visited, start, poses)
        reached = [i for i, path in enumerate(paths) if path is not None]
        sums = [steps[np.searchsorted(visited, paths[i] or [])].sum(0) for i in reached]
        out: list[F64 | None] = [None] * len(goals)
        if reached:  # from perturbing `start` to perturbing the goal
            goal_poses = np.array([poses[goals[i]] for i in reached])
            covs = se3.inverse_cov(se3.inverse(goal_poses) @ poses[start], np.array(sums))
            for i, cov in zip(reached, covs, strict=True):
                out[i] = cov
        return out

    def _updated_paths(self) -> ShortestPaths:
        if self._removed:
            a, b = np.array(list(self._removed.values()), np.int64).T
            self._paths.remove(a, b, np.array(list(self._removed), np.int64))
            self._removed.clear()
        if self._added:
            rows = np.array(list(self._added), np.int64)
            a, b, cov_trace = self._table[rows, :3].T
            size = len(self._slots) + len(self._free_slots)
            self._paths.add(size, a.astype(np.int64), b.astype(np.int64), cov_trace, rows)
            self._added.clear()
        return self._paths

    def _path_slots(self, predecessors: I64, start: int, goal: int) -> list[int] | None:
        """Slots on the path from `goal` back to `start`, the latter excluded; None without a path."""
        slot, start_slot = self._slots.get(goal, -1), self._slots[start]
        path: list[int] = []
        while slot != start_slot:
            if slot < 0:
                return None
            path.append(slot)
            slot = int(predecessors[slot])
        return path

    def _step_covariances(self, predecessors: I64, visited: I64, start: int, poses: PosesById) -> F64:
        """Covariances (K, 6, 6) of the steps from `predecessors` to `visited`, perturbing T_start_start."""
        rows = self._updated_paths().cheapest_edges(predecessors, visited)
        table = self._table[rows]
        is_forward = table[:, 1] == visited
        directed_edges = zip([self._edges[row] for row in rows], is_forward, strict=True)
        ends = [edge.b if is_forward_edge else edge.a for edge, is_forward_edge in directed_edges if edge]
        T_a_b, cov = table[:, 3:19].reshape(-1, 4, 4), table[:, 19:].reshape(-1, 6, 6)
        cov = np.where(is_forward[:, None, None], cov, se3.inverse_cov(T_a_b, cov))
        end_poses = np.array([poses[end] for end in ends]).reshape(-1, 4, 4)
        return se3.inverse_cov(se3.inverse(poses[start]) @ end_poses, cov)


# Covariances of solved poses: a tight upper bound
#
# The exact covariance costs a factorisation of the whole graph. Edges left out could only add information, so
# the covariance in a subgraph is an upper bound. The most informative subgraph is that of the paths of least
# covariance: once found, the cost of their edges is raised and the next paths are added, until there are
# enough edges.

MAX_EDGES = 250  # surest edges used; more: tighter and slower
_MAX_ROUNDS = 16  # of the search for shortest paths
_MIN_WEIGHT = 1e-9  # of a loop, to divide by
_UNKNOWN_COV = 1e6 * np.eye(6)


def relative_covariances(
    edges: EdgeArrays,
    gravity_factors: F64,
    result: OptimisedPoses,
    anchor: int,
    wanted: I64,
) -> F64:
    """Covariances (K, 6, 6) of `wanted` (K,) of n poses relative to `anchor`, right perturbation.

    gravity_factors (n, 3): where there are any, tilts are relative to gravity. Every wanted pose must be
    connected to the anchor. Where edges differ too much in certainty (beyond some 16 orders of magnitude) to
    give a result, a sigma of 1000 rad and m says so.
    """
    n, out = len(gravity_factors), np.zeros((len(wanted), 6, 6))
    not_anchor = np.flatnonzero(wanted != anchor)
    if not len(not_anchor):
        return out
    weights = np.maximum(result.weights, _MIN_WEIGHT)
    selected = _tightest_edges(n, edges, edges.cov_trace / weights, anchor, wanted[not_anchor])
    poses = np.unique(np.concatenate([edges.a[selected], edges.b[selected]]))
    local_edges = edges[selected].with_ends(
        *(np.searchsorted(poses, end[selected]) for end in (edges.a, edges.b))
    )
    equations = NormalEquations(
        len(poses), local_edges, int(np.searchsorted(poses, anchor)), result.gauge_projector
    )
    J = weighted_jacobians(result.residuals[selected], weights[selected], local_edges)
    unary = gravity_equations(result.poses[poses], gravity_factors[poses])
    out[not_anchor] = _inverse_diagonal_blocks(
        equations.information_matrix(J, unary), np.searchsorted(poses, wanted[not_anchor])
    )
    return out


def _tightest_edges(n: int, edges: EdgeArrays, cost: F64, anchor: int, wanted: I64) -> I64:
    """Indices of the edges on the paths of least covariance from the anchor to the wanted poses."""
    used, path_cost = np.zeros(len(edges), bool), cost.copy()
    paths = ShortestPaths(n, edges.a, edges.b, path_cost)
    for _ in range(_MAX_ROUNDS):
        predecessors = paths.predecessors(anchor)
        visited = poses_on_paths(predecessors, wanted)
        path_edges = paths.cheapest_edges(predecessors[visited], visited)
        used[path_edges] = True
        path_cost[path_edges] += 2 * cost[path_edges]
        if used.sum() >= MAX_EDGES:
            break
        paths.set_cost(path_cost)
    return np.flatnonzero(used)


def _inverse_diagonal_blocks(information: Any, wanted: I64) -> F64:
    """Diagonal blocks (K, 6, 6) of the inverse at `wanted`; unknown where it is singular by rounding."""
    from scipy.sparse.linalg import splu

    symmetric, k = {"SymmetricMode": True}, len(wanted)
    try:
        factor = splu(information, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
    except RuntimeError:  # edges 1e12 times as vague as others
        return np.repeat(_UNKNOWN_COV[None], k, axis=0)
    rows = 6 * wanted[:, None] + np.arange(6)
    right = np.zeros((information.shape[0], 6 * k))
    right[rows.ravel(), np.arange(6 * k)] = 1
    blocks = factor.solve(right)[rows.ravel()].reshape(k, 6, k, 6)
    blocks = blocks[np.arange(k), :, np.arange(k)]
    blocks = (blocks + np.swapaxes(blocks, 1, 2)) / 2
    is_positive = np.linalg.eigvalsh(blocks)[:, 0] > 0
    return np.where(is_positive[:, None, None], blocks, _UNKNOWN_COV)
