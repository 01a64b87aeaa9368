"""What goes to the solver and what comes back, as a few arrays: both cross to another process."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from share.graph.posegraph import Edge
from share.types import F64, I64, checked


@dataclass(frozen=True, eq=False)
class Change:
    """News of the graph. What is gone goes first, and a gone pose takes its edges along.

    numbers (N,), poses (N, 4, 4), rigid: new ones, and known ones that lie elsewhere now; plumb (N, 3) of
    each, see `share.graph.plumb`. edge_ids (E,),
    ends (E, 2), measured (E, 4, 4), covs (E, 6, 6): new edges, T_a_b with ends (a, b), right
    perturbation. is_loop (E,): may be false, so it is judged robustly. gone_edges, gone_poses: ids.
    """

    numbers: I64
    poses: F64
    plumb: F64
    edge_ids: I64
    ends: I64
    measured: F64
    covs: F64
    is_loop: np.ndarray[tuple[int], np.dtype[np.bool_]]
    gone_edges: I64
    gone_poses: I64

    def __post_init__(self) -> None:
        n, e = len(self.numbers), len(self.edge_ids)
        shapes = {
            "numbers": ((n,), np.int64),
            "poses": ((n, 4, 4), np.float64),
            "plumb": ((n, 3), np.float64),
            "edge_ids": ((e,), np.int64),
            "ends": ((e, 2), np.int64),
            "measured": ((e, 4, 4), np.float64),
            "covs": ((e, 6, 6), np.float64),
            "is_loop": ((e,), np.bool_),
            "gone_edges": ((None,), np.int64),
            "gone_poses": ((None,), np.int64),
        }
        for name, (shape, dtype) in shapes.items():
            object.__setattr__(self, name, checked(name, getattr(self, name), shape, dtype))

    @staticmethod
    def of(
        poses: Mapping[int, F64],
        edges: Iterable[tuple[int, Edge, bool]] = (),
        gone_edges: Iterable[int] = (),
        gone_poses: Iterable[int] = (),
        plumb: Mapping[int, F64] | None = None,
    ) -> Change:
        """From poses by number, and edges as (id, edge, may it be false). plumb: by number, of some of the
        poses."""
        edges, plumb = list(edges), plumb or {}
        return Change(
            np.array(list(poses), np.int64),
            np.array(list(poses.values()) or np.zeros((0, 4, 4)), np.float64),
            np.array([plumb.get(number, np.zeros(3)) for number in poses], np.float64).reshape(-1, 3),
            np.array([i for i, _, _ in edges], np.int64),
            np.array([(edge.a, edge.b) for _, edge, _ in edges], np.int64).reshape(-1, 2),
            np.array([edge.T_a_b for _, edge, _ in edges], np.float64).reshape(-1, 4, 4),
            np.array([edge.cov for _, edge, _ in edges], np.float64).reshape(-1, 6, 6),
            np.array([loop for _, _, loop in edges], np.bool_),
            np.array(list(gone_edges), np.int64),
            np.array(list(gone_poses), np.int64),
        )


@dataclass(frozen=True, eq=False)
class Solution:
    """One connected part, solved.

    numbers (N,), poses (N, 4, 4): rising, all of the part. covariances (K, 6, 6): of the poses asked
    for relative to the anchor, right perturbation, never too small (`share.graph.bound`). loop_ids
    (L,), loop_chi2 (L,): squared Mahalanobis residual. reason: why it could not be solved, the poses
    are as they were and there are no covariances; empty if it was.
    """

    numbers: I64
    poses: F64
    covariances: F64
    loop_ids: I64
    loop_chi2: F64
    iterations: int
    reason: str = ""
