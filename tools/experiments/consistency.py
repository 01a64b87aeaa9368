"""Consistency of an estimator: are errors as large as its covariances claim?

The truth is aligned with odometry at one pose of each segment, the one with the smallest covariance: mostly
the first, which defines odom. Source: Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking
and Navigation* (2001), 5.4.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.types import F64, I64


@dataclass(frozen=True, eq=False)
class Deviations:
    """Estimated minus true poses along odom's axes: rotation [rad], then translation [m].

    errors (N, 6); cov (N, 6, 6): the estimator's covariance, with that of the pose at which truth is aligned.
    is_aligned (N,): whether it is this pose, whose error is 0.
    """

    errors: F64
    cov: F64
    is_aligned: NDArray[np.bool_]

    @property
    def sigmas(self) -> F64:
        """(N, 6)."""
        out: F64 = np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))
        return out


def deviations(T_odom_body: F64, cov: F64, T_world_body: F64, segment: I64) -> Deviations:
    """Compare estimated poses (N, 4, 4), with covariances (N, 6, 6) perturbed on the right, with the truth
    (N, 4, 4).

    segment (N,): number of the odometry segment of each pose.
    """
    sizes = np.linalg.slogdet(cov)[1]  # -inf of a pose that is known exactly
    numbers, segment = np.unique(segment, return_inverse=True)
    best = np.array(
        [rows[sizes[rows].argmin()] for k in range(len(numbers)) for rows in np.nonzero(segment == k)]
    )
    reference = best[segment]
    T_reference_body = se3.inverse(T_world_body[reference]) @ T_world_body
    true = T_odom_body[reference] @ T_reference_body
    is_aligned = reference == np.arange(len(reference))
    cov = np.where(is_aligned[:, None, None], cov, se3.compose_cov(T_reference_body, cov[reference], cov))
    R = T_odom_body[:, :3, :3]
    rotation_errors = se3.so3_log(R @ np.swapaxes(true[:, :3, :3], 1, 2))
    errors = np.concatenate([rotation_errors, T_odom_body[:, :3, 3] - true[:, :3, 3]], axis=1)
    axes = np.zeros((len(R), 6, 6))
    axes[:, :3, :3] = axes[:, 3:, 3:] = R
    return Deviations(errors, axes @ cov @ np.swapaxes(axes, 1, 2), is_aligned)


def nees(errors: F64, cov: F64) -> F64:
    """Return the normalised estimation error squared (N,) of errors (N, D) with covariances (N, D, D).

    Its mean is D for a consistent estimator. A zero covariance makes it infinite.
    """
    scale = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    with np.errstate(divide="ignore", invalid="ignore"):
        normalised = errors / scale
        correlation = cov / (scale[:, :, None] * scale[:, None, :])
    known = np.isfinite(correlation).all(axis=(1, 2))
    out = np.full(len(errors), np.inf)
    solved = np.linalg.solve(correlation[known], normalised[known][:, :, None])[:, :, 0]
    out[known] = (normalised[known] * solved).sum(1)
    return out


def share_within(errors: F64, sigmas: F64, sigma_factor: float = 3.0) -> float:
    """Return the fraction of errors (N, D), N >= 1, within `sigma_factor` sigmas (N, D) on every axis."""
    return float((np.abs(errors) <= sigma_factor * sigmas).all(axis=1).mean())
