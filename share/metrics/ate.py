"""Absolute trajectory error (ATE): position error of an estimate after alignment with the truth.

Source: Sturm et al., *A Benchmark for the Evaluation of RGB-D SLAM Systems*, IROS 2012, eq. 3;
Zhang & Scaramuzza, *A Tutorial on Quantitative Trajectory Evaluation*, IROS 2018. Protocol:
docs/do/evaluate.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from share.errors import DataError
from share.geometry.interpolation import MAX_GAP_NS, Trajectory, associate, require_poses
from share.geometry.se3 import inverse, transform, umeyama
from share.types import F64

Alignment = Literal["se3", "origin", "none"]

_MIN_POSES = {"se3": 3, "origin": 1, "none": 1}  # associated poses that an alignment needs


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


def ate(
    estimate: Trajectory,
    truth: Trajectory,
    alignment: Alignment = "se3",
    max_gap_ns: int = MAX_GAP_NS,
) -> Ate:
    """Return the ATE of one trajectory. Alignment `se3`: least squares over all positions; `origin`: first
    poses made equal; `none`: as given. Raises DataError if too few poses have a truth at their time."""
    _, T_est, T_truth = associate(estimate, truth, max_gap_ns)
    require_poses(len(T_est), _MIN_POSES[alignment], "ATE")
    return _ate_under(_fit_alignment(T_est, T_truth, alignment), T_est, T_truth)


def ate_if_known(estimate: Trajectory | None, truth: Trajectory | None) -> Ate | None:
    """Return the ATE (SE3 alignment); None without an estimate, a truth, or enough poses with a truth."""
    if estimate is None or truth is None:
        return None
    try:
        return ate(estimate, truth)
    except DataError:
        return None


def joint_ate(
    pairs: Mapping[str, tuple[Trajectory, Trajectory]],
    alignment: Literal["se3", "none"] = "se3",
    max_gap_ns: int = MAX_GAP_NS,
) -> JointAte:
    """Return the ATE of agents in one map: {name: (estimate, truth)}, one alignment over all their frames, so
    that a wrongly merged agent shows.

    An agent without an associated pose is left out of `agents`. Raises DataError if all poses together are
    too few.
    """
    associated = {name: associate(*pair, max_gap_ns)[1:] for name, pair in pairs.items()}
    associated = {name: pair for name, pair in associated.items() if len(pair[0])}
    require_poses(sum(len(T) for T, _ in associated.values()), _MIN_POSES[alignment], "joint ATE")
    all_est, all_truth = (np.concatenate(side) for side in zip(*associated.values(), strict=True))
    T = _fit_alignment(all_est, all_truth, alignment)
    agents = {name: _ate_under(T, *pair) for name, pair in associated.items()}
    return JointAte(_ate_under(T, all_est, all_truth), agents)


def position_errors(T_truth_est: F64, T_est: F64, T_truth: F64) -> F64:
    """Return distances (N,), m, of associated poses (N, 4, 4) under an alignment (4, 4)."""
    out: F64 = np.linalg.norm(transform(T_truth_est, T_est[:, :3, 3]) - T_truth[:, :3, 3], axis=1)
    return out


def _fit_alignment(T_est: F64, T_truth: F64, alignment: Alignment) -> F64:
    if alignment == "se3":
        return umeyama(T_est[:, :3, 3], T_truth[:, :3, 3])
    if alignment == "origin":
        T: F64 = T_truth[0] @ inverse(T_est[0])
        return T
    return np.eye(4)


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
