"""Whether the accelerometer finds the mocap's ways as long as the mocap does, along each of its axes.

One more unknown an axis, for which the fit was not solved: a step of Gauss and Newton from where it ended,
all other unknowns free (the Schur complement of the three). An axis that is mirrored shows as a scale far
from 1 even where so little goes along it that the path comes together all the same.
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
    """By how much positions (3,) along the axes of the mocap's world are too long, 0.01: 1 %, and the
    covariance (3, 3). sigma m: noise of a position; share: what one sample counts for."""
    p = mocap.T[:, :3, 3] + solved.observations.residual[:, 3:] * sigma  # as fitted: noise has no length
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
    """How all others give way, (N, 15) and (10,), to a pull of `nodes` (N, 15) and `shared` (10,)."""
    return solve_bordered(replace(normal, b_nodes=nodes, b_shared=shared), 0.0)[:2]
