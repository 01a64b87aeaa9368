"""The pose graph by gtsam, to compare with: Levenberg-Marquardt, Cauchy loops, exact covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from share.geometry import se3
from share.mapping.graph.edges import PoseEdge
from share.mapping.graph.optimiser import MAX_ITERATIONS, RELATIVE_TOLERANCE
from share.mapping.graph.solver import CAUCHY_WIDTH
from share.types import F64

ANCHOR_SIGMA = 1e-4  # rad and m; holds the gauge, removed again after solving


@dataclass(frozen=True, eq=False)
class SolvedGraph:
    """poses (N, 4, 4). covariances (K, 6, 6) of the poses asked for, right perturbation, relative
    to the anchors. odometry_chi2, loop_chi2: squared Mahalanobis residual of every edge."""

    poses: F64
    covariances: F64
    odometry_chi2: F64
    loop_chi2: F64


def solve(
    poses: F64,
    odometry: Sequence[PoseEdge],
    loops: Sequence[PoseEdge],
    anchors: Sequence[int],
    covariances_of: Sequence[int] = (),
    cauchy_width: float = CAUCHY_WIDTH,
    relative_tolerance: float = RELATIVE_TOLERANCE,
) -> SolvedGraph:
    """The most likely poses, starting from `poses` (N, 4, 4); anchored ones stay exactly as given.

    Every connected part needs one anchor at least. Deterministic. Raises ValueError if an edge or
    anchor names a pose that is not there, or if a part has no anchor.
    """
    import gtsam

    _check(len(poses), odometry, loops, anchors)
    graph = gtsam.NonlinearFactorGraph()
    for index in anchors:
        graph.add(gtsam.PriorFactorPose3(index, gtsam.Pose3(poses[index]), _gaussian(ANCHOR_SIGMA**2)))
    for edge in odometry:
        graph.add(_between(edge, gtsam.noiseModel.Gaussian.Covariance(edge.cov)))
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(cauchy_width)
    for edge in loops:
        gaussian = gtsam.noiseModel.Gaussian.Covariance(edge.cov)
        graph.add(_between(edge, gtsam.noiseModel.Robust.Create(cauchy, gaussian)))
    initial = gtsam.Values()
    for index, T in enumerate(poses):
        initial.insert(index, gtsam.Pose3(se3.orthonormal(T)))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(MAX_ITERATIONS)
    parameters.setRelativeErrorTol(relative_tolerance)
    values = gtsam.LevenbergMarquardtOptimizer(graph, initial, parameters).optimize()
    solved = np.array([values.atPose3(i).matrix() for i in range(len(poses))])
    solved[list(anchors)] = poses[list(anchors)]
    return SolvedGraph(
        solved, _marginals(graph, values, covariances_of), chi2(solved, odometry), chi2(solved, loops)
    )


def chi2(poses: F64, edges: Sequence[PoseEdge]) -> F64:
    """Squared Mahalanobis residual (E,) of every edge at `poses` (N, 4, 4)."""
    if not edges:
        return np.zeros(0)
    a, b = np.array([(e.a, e.b) for e in edges]).T
    measured = np.array([e.T_a_b for e in edges])
    residual = se3.log(se3.inverse(measured) @ se3.inverse(poses[a]) @ poses[b])
    whitened = np.linalg.solve(np.array([e.cov for e in edges]), residual[:, :, None])
    return np.asarray((residual * whitened[:, :, 0]).sum(1), np.float64)


def _between(edge: PoseEdge, noise: Any) -> Any:
    import gtsam

    return gtsam.BetweenFactorPose3(edge.a, edge.b, gtsam.Pose3(edge.T_a_b), noise)


def _gaussian(variance: float) -> Any:
    import gtsam

    return gtsam.noiseModel.Isotropic.Variance(6, variance)


def _marginals(graph: Any, values: Any, wanted: Sequence[int]) -> F64:
    """Covariances (K, 6, 6) from the information at the solution, robust weights included."""
    if not wanted:
        return np.zeros((0, 6, 6))
    import gtsam

    marginals = gtsam.Marginals(graph, values)
    return np.array([marginals.marginalCovariance(index) for index in wanted])


def _check(n: int, odometry: Sequence[PoseEdge], loops: Sequence[PoseEdge], anchors: Sequence[int]) -> None:
    parent = list(range(n))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    for edge in (*odometry, *loops):
        if max(edge.a, edge.b) >= n:
            raise ValueError(f"edge {edge.a} - {edge.b}: there are {n} poses")
        parent[root(edge.a)] = root(edge.b)
    if any(not 0 <= i < n for i in anchors):
        raise ValueError(f"anchors {list(anchors)}: there are {n} poses")
    loose = {root(i) for i in range(n)} - {root(i) for i in anchors}
    if loose:
        raise ValueError(f"poses {sorted(loose)[:3]} are not joined to an anchor")
