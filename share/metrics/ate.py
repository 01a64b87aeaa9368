"""Absolute trajectory error (ATE): position error of an estimate after alignment with the truth.

Source: Sturm et al., *A Benchmark for the Evaluation of RGB-D SLAM Systems*, IROS 2012, eq. 3;
Zhang & Scaramuzza, *A Tutorial on Quantitative Trajectory Evaluation*, IROS 2018. Protocol:
docs/do/evaluate.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from share.errors import DataError
from share.geometry.interpolation import Trajectory, associate, require_poses
from share.geometry.se3 import transform, umeyama
from share.types import F64

_MIN_POSES = 3  # associated ones, that the alignment needs


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of n errors, in their unit."""

    rmse: float
    mean: float
    median: float
    max: float
    n: int


@dataclass(frozen=True, eq=False)
class Ate(ErrorStatistics):
    """Position errors in m under the alignment T_truth_est (4, 4): p_truth ~ T_truth_est p_est."""

    T_truth_est: F64


@dataclass(frozen=True, eq=False)
class JointAte:
    """ATE over all agents' frames and of each agent, under the one alignment of `joint`."""

    joint: Ate
    agents: dict[str, Ate]


def ate(estimate: Trajectory, truth: Trajectory) -> Ate:
    """Return the ATE of one trajectory after SE3 alignment: least squares over all positions. Raises
    DataError if too few poses have a truth at their time."""
    _, T_est, T_truth = associate(estimate, truth)
    require_poses(len(T_est), _MIN_POSES, "ATE")
    return _ate_under(_fit_alignment(T_est, T_truth), T_est, T_truth)


def ate_if_known(estimate: Trajectory | None, truth: Trajectory | None) -> Ate | None:
    """Return the ATE; None without an estimate, a truth, or enough poses with a truth."""
    if estimate is None or truth is None:
        return None
    try:
        return ate(estimate, truth)
    except DataError:
        return None


def joint_ate(pairs: Mapping[str, tuple[Trajectory, Trajectory]]) -> JointAte:
    """Return the ATE of agents in one map: {name: (estimate, truth)}, one alignment over all their frames, so
    that a wrongly merged agent shows.

    An agent without an associated pose is left out of `agents`. Raises DataError if all poses together are
    too few.
    """
    associated = {name: associate(*pair)[1:] for name, pair in pairs.items()}
    associated = {name: pair for name, pair in associated.items() if len(pair[0])}
    require_poses(sum(len(T) for T, _ in associated.values()), _MIN_POSES, "joint ATE")
    all_est, all_truth = (np.concatenate(side) for side in zip(*associated.values(), strict=True))
    T = _fit_alignment(all_est, all_truth)
    agents = {name: _ate_under(T, *pair) for name, pair in associated.items()}
    return JointAte(_ate_under(T, all_est, all_truth), agents)


def position_errors(T_truth_est: F64, T_est: F64, T_truth: F64) -> F64:
    """Return distances (N,), m, of associated poses (N, 4, 4) under an alignment (4, 4)."""
    out: F64 = np.linalg.norm(transform(T_truth_est, T_est[:, :3, 3]) - T_truth[:, :3, 3], axis=1)
    return out


def _fit_alignment(T_est: F64, T_truth: F64) -> F64:
    return umeyama(T_est[:, :3, 3], T_truth[:, :3, 3])


def _ate_under(T: F64, T_est: F64, T_truth: F64) -> Ate:
    """Return the ATE of associated poses (N, 4, 4) under the alignment T (4, 4)."""
    return Ate(**vars(error_statistics(position_errors(T, T_est, T_truth))), T_truth_est=T)


def error_statistics(errors: F64) -> ErrorStatistics:
    """Return statistics of errors (N,), N >= 1, non-negative."""
    return ErrorStatistics(
        rmse=float(np.sqrt(np.mean(errors**2))),
        mean=float(errors.mean()),
        median=float(np.median(errors)),
        max=float(errors.max()),
        n=len(errors),
    )
