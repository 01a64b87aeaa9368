"""Messages to and from the solver, and the removal of a pose from the graph.

Of the odometry a - x - b one edge a - b stays when x is removed; loops at x move to its neighbour along the
more certain of the two edges. That edge e then enters several edges: every moved loop, and a - b. Each gets a
share of its information and the shares sum to one, so nothing is counted twice, as if x were split into
unconnected copies; omitting connections is conservative. Source of the idea: covariance intersection; Julier
and Uhlmann, *A Non-divergent Estimation Algorithm*, ACC 1997.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.mapping.graph.edges import PoseEdge
from share.types import F64, I64, checked_array


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


@dataclass(frozen=True, eq=False)
class ContractedEdges:
    """Edges that replace those of a removed pose.

    odometry: all but the one along which the others moved; none at the end of a chain. loops: one for each
    given, None where both ends would be the same pose.
    """

    odometry: tuple[PoseEdge, ...]
    loops: tuple[PoseEdge | None, ...]


def contract_pose(
    pose: int, odometry: Sequence[PoseEdge], loops: Sequence[PoseEdge], share: float = 0.5
) -> ContractedEdges:
    """Return the edges that replace all `odometry` and `loops` edges at `pose`.

    share: share of the information of the edge along which others move that goes to odometry; loops share the
    rest equally. Raises ValueError if the pose has no odometry edge, or if an edge does not end at it.
    """
    unrelated = [edge for edge in (*odometry, *loops) if pose not in (edge.a, edge.b)]
    if unrelated or not odometry:
        raise ValueError(
            f"pose {pose}: {'an edge does not end at it' if unrelated else 'it has no odometry edge'}"
        )
    path_edge = min(odometry, key=lambda edge: edge.cov_trace)
    neighbour = path_edge.a if path_edge.b == pose else path_edge.b
    others = [edge for edge in odometry if edge is not path_edge and neighbour not in (edge.a, edge.b)]
    moving_loops = [edge for edge in loops if neighbour not in (edge.a, edge.b)]
    to_odometry = share if moving_loops else 1.0
    to_loops = 1 - share if others else 1.0
    moved_edges = {
        id(edge): _move_end(edge, pose, neighbour, path_edge, to_odometry / len(others)) for edge in others
    }
    moved_edges |= {
        id(edge): _move_end(edge, pose, neighbour, path_edge, to_loops / len(moving_loops))
        for edge in moving_loops
    }
    return ContractedEdges(
        tuple(moved_edges[id(edge)] for edge in others), tuple(moved_edges.get(id(edge)) for edge in loops)
    )


def _move_end(edge: PoseEdge, old_end: int, new_end: int, path_edge: PoseEdge, share: float) -> PoseEdge:
    """Move an end of `edge` along `path_edge`, with `share` of the latter's information."""
    oriented_path = path_edge if path_edge.a == old_end else path_edge.reverse()
    incoming = edge if edge.b == old_end else edge.reverse()
    cov = se3.compose_cov(oriented_path.T_a_b, incoming.cov, oriented_path.cov / share)
    result = PoseEdge(incoming.a, new_end, se3.orthonormal(incoming.T_a_b @ oriented_path.T_a_b), cov)
    return result if edge.b == old_end else result.reverse()


def fuse_edges(edges: Sequence[PoseEdge]) -> tuple[PoseEdge, float]:
    """Fuse edges between the same two poses; return the fused edge and the chi-square of 6 (K - 1) dof.

    Directed as the first. A large chi-square means that one of them is false. Raises ValueError if they do
    not connect the same two poses.
    """
    first = edges[0]
    if any({edge.a, edge.b} != {first.a, first.b} for edge in edges):
        raise ValueError("edges to fuse must connect the same two poses")
    aligned = [edge if edge.a == first.a else edge.reverse() for edge in edges]
    xi = se3.log(se3.inverse(first.T_a_b) @ np.array([edge.T_a_b for edge in aligned]))
    information = np.linalg.inv(np.array([edge.cov for edge in aligned]))
    cov = np.linalg.inv(information.sum(0))
    mean = cov @ np.einsum("kij,kj->i", information, xi)
    chi2 = np.einsum("ki,kij,kj->", xi - mean, information, xi - mean)
    return PoseEdge(first.a, first.b, se3.orthonormal(first.T_a_b @ se3.exp(mean)), cov), float(chi2)
