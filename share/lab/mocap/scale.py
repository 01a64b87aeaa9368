"""Compare the scale of the mocap's axes with the accelerometer.

One unknown per axis that the fit did not have: a Gauss-Newton step from its solution with all other unknowns
free (the Schur complement of the three). A mirrored axis shows as a scale far from 1 even where the path
moves so little along it that the fit converges.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from share.lab.mocap.problem import BatchSolution, BorderedNormals, solve_bordered
from share.lab.mocap.trajectory import MocapTrajectory
from share.types import F64


def axis_scales(
    solved: BatchSolution, mocap: MocapTrajectory, sigma: float, sample_weight: float
) -> tuple[F64, F64]:
    """Return by how much positions along the axes of the mocap's world are too long, (3,), 0.01: 1 %, and
    the covariance (3, 3). sigma m: noise of a position. sample_weight: of one sample."""
    # positions as fitted, since noise would bias the scale
    p = mocap.T[:, :3, 3] + solved.observations.residual[:, 3:] * sigma
    p = p - p.mean(0)
    J = np.zeros((len(p), 6, 3))
    J[:, 3:] = -p[:, None] * np.eye(3) / sigma
    weight = solved.weight * solved.is_inlier * sample_weight
    JW = (J * weight[:, None, None]).swapaxes(1, 2)
    nodes = np.zeros((len(solved.normal.b_nodes), solved.observations.jacobian_node.shape[2], 3))
    np.add.at(nodes, solved.observations.node, (JW @ solved.observations.jacobian_node).swapaxes(1, 2))
    shared = (JW @ solved.observations.jacobian_shared).sum(0).T
    responses = [_response(solved.normal, nodes[..., k], shared[:, k]) for k in range(3)]
    information = (JW @ J).sum(0)
    gradient = (JW @ solved.observations.residual[..., None]).sum(0)[:, 0]
    for k, (by_node, by_shared) in enumerate(responses):
        information[:, k] += np.einsum("nij,ni->j", nodes, by_node) + shared.T @ by_shared
        gradient[k] += (solved.normal.b_nodes * by_node).sum() + solved.normal.b_shared @ by_shared
    cov = np.linalg.inv((information + information.T) / 2)
    return np.asarray(cov @ gradient, np.float64), cov


def _response(normal: BorderedNormals, nodes: F64, shared: F64) -> tuple[F64, F64]:
    """Return the response, (N, 15) and (10,), of all other unknowns to a gradient of `nodes` (N, 15) and
    `shared` (10,)."""
    return solve_bordered(replace(normal, b_nodes=nodes, b_shared=shared), 0.0)[:2]
