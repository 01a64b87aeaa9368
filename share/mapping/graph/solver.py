"""Incremental pose-graph solver: it receives only changes, and starts from the last solution.

Runs in one thread, without a clock. Cost: docs/understand/mapping.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from share.checks import checked_array
from share.mapping.graph.covariance import relative_covariances
from share.mapping.graph.edges import EdgeArrays, PoseEdge
from share.mapping.graph.gravity import restore_tilt, turned_upright
from share.mapping.graph.optimiser import chain_order, optimise
from share.types import F64, I64


@dataclass(frozen=True, eq=False)
class GraphUpdate:
    """Changes of the graph, as arrays that can cross to another process. Removals apply first; a removed pose
    takes its edges along.

    pose_ids (N,), poses (N, 4, 4), gravity_factors (N, 3): new or moved poses. edge_ids (E,), ends (E, 2) as
    (a, b), T_a_b (E, 4, 4), covs (E, 6, 6), right perturbation: new edges. is_loop (E,): under the robust
    kernel. removed_edges, removed_poses: ids.
    """

    pose_ids: I64
    poses: F64
    gravity_factors: F64
    edge_ids: I64
    ends: I64
    T_a_b: F64
    covs: F64
    is_loop: np.ndarray[tuple[int], np.dtype[np.bool_]]
    removed_edges: I64
    removed_poses: I64

    def __post_init__(self) -> None:
        n, e = len(self.pose_ids), len(self.edge_ids)
        shapes = {
            "pose_ids": ((n,), np.int64),
            "poses": ((n, 4, 4), np.float64),
            "gravity_factors": ((n, 3), np.float64),
            "edge_ids": ((e,), np.int64),
            "ends": ((e, 2), np.int64),
            "T_a_b": ((e, 4, 4), np.float64),
            "covs": ((e, 6, 6), np.float64),
            "is_loop": ((e,), np.bool_),
            "removed_edges": ((None,), np.int64),
            "removed_poses": ((None,), np.int64),
        }
        for name, (shape, dtype) in shapes.items():
            object.__setattr__(self, name, checked_array(name, getattr(self, name), shape, dtype))

    @staticmethod
    def from_edges(
        poses: Mapping[int, F64],
        edges: Iterable[tuple[int, PoseEdge, bool]] = (),
        removed_edges: Iterable[int] = (),
        removed_poses: Iterable[int] = (),
        gravity_factors: Mapping[int, F64] | None = None,
    ) -> GraphUpdate:
        """From poses by id and edges as (id, edge, is_loop). gravity_factors: by id, of some of the poses."""
        edges, gravity_factors = list(edges), gravity_factors or {}
        return GraphUpdate(
            np.array(list(poses), np.int64),
            np.array(list(poses.values()) or np.zeros((0, 4, 4)), np.float64),
            np.array([gravity_factors.get(node_id, np.zeros(3)) for node_id in poses], np.float64).reshape(
                -1, 3
            ),
            np.array([i for i, _, _ in edges], np.int64),
            np.array([(edge.a, edge.b) for _, edge, _ in edges], np.int64).reshape(-1, 2),
            np.array([edge.T_a_b for _, edge, _ in edges], np.float64).reshape(-1, 4, 4),
            np.array([edge.cov for _, edge, _ in edges], np.float64).reshape(-1, 6, 6),
            np.array([loop for _, _, loop in edges], np.bool_),
            np.array(list(removed_edges), np.int64),
            np.array(list(removed_poses), np.int64),
        )


@dataclass(frozen=True, eq=False)
class GraphSolution:
    """Solution of one connected component.

    pose_ids (N,), ascending, poses (N, 4, 4). covariances (K, 6, 6): of the wanted poses relative to the
    anchor, right perturbation, upper bounds (`share.mapping.graph.covariance`). loop_ids (L,), loop_chi2
    (L,): squared Mahalanobis residual. reason: why it is not solved; then poses are unchanged and there are
    no covariances; empty if solved.
    """

    pose_ids: I64
    poses: F64
    covariances: F64
    loop_ids: I64
    loop_chi2: F64
    iterations: int
    reason: str = ""


CAUCHY_WIDTH = 3.0  # 2.4 is usual for 6 degrees of freedom


class PoseGraphSolver:
    """All poses, by id, and the edges between them, of all maps."""

    def __init__(self, cauchy_width: float = CAUCHY_WIDTH) -> None:
        """cauchy_width: whitened residual at which a loop has half its weight."""
        self._cauchy_width = cauchy_width
        self.clear()

    def clear(self) -> None:
        empty = GraphUpdate.from_edges({})
        self._pose_ids = empty.pose_ids  # ascending
        self._poses, self._gravity_factors = empty.poses, empty.gravity_factors
        self._edge_ids, self._edges = empty.edge_ids, _edge_arrays(empty)  # ends are pose ids

    def __len__(self) -> int:
        return len(self._pose_ids)

    def update(self, change: GraphUpdate) -> None:
        """Apply changes.

        Raises ValueError, and stays unchanged, for an unknown edge or pose to remove, a duplicate edge id, or
        an edge with an unknown end.
        """
        pose_ids, poses, gravity_factors = self._poses_after(change)
        edge_ids, edges = self._edges_after(change, pose_ids)
        self._pose_ids, self._poses, self._gravity_factors = pose_ids, poses, gravity_factors
        self._edge_ids, self._edges = edge_ids, edges

    def solve(self, anchor: int, wanted: Sequence[int] = ()) -> GraphSolution:
        """Return the most likely poses of the component of pose `anchor`.

        The anchor stays, except that all poses turn slowly upright about it where gravity factors are known:
        agents would notice a map that turned at once. wanted: poses whose covariances are returned, without
        the tilt that the whole map shares. An unsolvable component is returned unchanged, with the reason.
        Deterministic. Raises ValueError if the anchor is unknown or a wanted pose is not connected to it.
        """
        component, component_edges = self._component(anchor)
        pose_ids, edges = self._pose_ids[component], self._edges[component_edges]
        goals = _indices(pose_ids, np.array(wanted, np.int64), f"connected to {anchor}")
        local_edges = edges.with_ends(np.searchsorted(pose_ids, edges.a), np.searchsorted(pose_ids, edges.b))
        order = chain_order(len(component), local_edges[~local_edges.is_loop])
        rank = np.argsort(order)
        ordered_edges = local_edges.with_ends(rank[local_edges.a], rank[local_edges.b])
        anchor_index = int(rank[np.searchsorted(pose_ids, anchor)])
        gravity_factors, before = self._gravity_factors[component][order], self._poses[component][order]
        upright = turned_upright(before, gravity_factors, anchor_index)
        minimum = optimise(upright, gravity_factors, ordered_edges, anchor_index, self._cauchy_width)
        poses = (before if minimum.reason else restore_tilt(minimum.poses, before, anchor_index))[rank]
        if minimum.reason:
            goals = goals[:0]
        else:
            self._poses = _with_poses(self._poses, component, poses)
        return GraphSolution(
            pose_ids,
            poses,
            relative_covariances(ordered_edges, gravity_factors, minimum, anchor_index, rank[goals]),
            self._edge_ids[component_edges][edges.is_loop],
            minimum.residuals.chi2[edges.is_loop],
            minimum.iterations,
            minimum.reason,
        )

    def _component(self, anchor: int) -> tuple[I64, I64]:
        """Indices of the poses connected to `anchor`, and of the edges between them."""
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import connected_components

        anchor_index = _indices(self._pose_ids, np.array([anchor]), "known")[0]
        a, b = np.searchsorted(self._pose_ids, self._edges.a), np.searchsorted(self._pose_ids, self._edges.b)
        n = len(self._pose_ids)
        graph = csr_array((np.ones(len(a)), (a, b)), shape=(n, n))
        label = connected_components(graph, directed=False)[1]
        return np.flatnonzero(label == label[anchor_index]), np.flatnonzero(label[a] == label[anchor_index])

    def _poses_after(self, change: GraphUpdate) -> tuple[I64, F64, F64]:
        is_kept = np.ones(len(self._pose_ids), bool)
        is_kept[_indices(self._pose_ids, change.removed_poses, "known")] = False
        pose_ids = np.union1d(self._pose_ids[is_kept], change.pose_ids)
        poses, gravity_factors = np.empty((len(pose_ids), 4, 4)), np.empty((len(pose_ids), 3))
        for known_ids, known_poses, known_gravity in (
            (self._pose_ids[is_kept], self._poses[is_kept], self._gravity_factors[is_kept]),
            (change.pose_ids, change.poses, change.gravity_factors),
        ):
            indices = np.searchsorted(pose_ids, known_ids)
            poses[indices], gravity_factors[indices] = known_poses, known_gravity
        return pose_ids, poses, gravity_factors

    def _edges_after(self, change: GraphUpdate, pose_ids: I64) -> tuple[I64, EdgeArrays]:
        _require(np.isin(change.removed_edges, self._edge_ids), change.removed_edges, "edge", "is not known")
        is_removed = np.isin(self._edge_ids, change.removed_edges)
        for end in (self._edges.a, self._edges.b):
            is_removed |= np.isin(end, change.removed_poses)
        edge_ids = np.concatenate([self._edge_ids[~is_removed], change.edge_ids])
        counts = np.unique(edge_ids, return_counts=True)
        _require(counts[1] == 1, counts[0], "edge", "is known already")
        _indices(pose_ids, change.ends.ravel(), "known")
        return edge_ids, self._edges[~is_removed].concatenate(_edge_arrays(change))


def _edge_arrays(change: GraphUpdate) -> EdgeArrays:
    return EdgeArrays.from_measurements(change.ends, change.T_a_b, change.covs, change.is_loop)


def _with_poses(poses: F64, indices: I64, new: F64) -> F64:
    poses = poses.copy()
    poses[indices] = new
    return poses


def _indices(pose_ids: I64, wanted: I64, what: str) -> I64:
    """Indices of `wanted` in the ascending `pose_ids`. Raises ValueError if one is missing."""
    _require(np.isin(wanted, pose_ids), wanted, "pose", f"is not {what}")
    return np.searchsorted(pose_ids, wanted)


def _require(is_valid: Any, ids: I64, kind: str, reason: str) -> None:
    if not np.all(is_valid):
        raise ValueError(f"{kind} {ids[~is_valid][0]} {reason}")
