"""Whether errors are as large as an estimator says that they may be.

Truth is laid over odometry by what odometry leaves free and no more: heading and position, at the first
pose of each unbroken stretch. A wrong tilt is an error, and what it does later is too.
Source: Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and Navigation* (2001), 5.4.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.types import F64, I64


@dataclass(frozen=True, eq=False)
class Deviations:
    """Of N poses, along odom's axes: rotation [rad], then translation [m]; told less true.

    errors (N, 6); cov (N, 6, 6): what the estimator says of them.
    """

    errors: F64
    cov: F64

    @property
    def sigmas(self) -> F64:
        """(N, 6)."""
        out: F64 = np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))
        return out


def deviations(T_odom_body: F64, cov: F64, T_world_body: F64, stretch: I64) -> Deviations:
    """Of told poses (N, 4, 4) with covariances (N, 6, 6), perturbed on the right, against the truth
    (N, 4, 4). stretch (N,): which unbroken stretch each belongs to."""
    T_odom_world = np.zeros_like(T_world_body)
    for number in np.unique(stretch):
        these = np.flatnonzero(stretch == number)
        T_odom_world[these] = upright(T_odom_body[these[0]], T_world_body[these[0]])
    true = T_odom_world @ T_world_body
    R = T_odom_body[:, :3, :3]
    turned = se3.so3_log(R @ np.swapaxes(true[:, :3, :3], 1, 2))
    errors = np.concatenate([turned, T_odom_body[:, :3, 3] - true[:, :3, 3]], axis=1)
    axes = np.zeros((len(R), 6, 6))
    axes[:, :3, :3] = axes[:, 3:, 3:] = R
    return Deviations(errors, axes @ cov @ np.swapaxes(axes, 1, 2))


def upright(T_odom_body: F64, T_world_body: F64) -> F64:
    """T_odom_world (4, 4), a turn about the vertical and a shift, that makes the positions of the two poses
    equal and leaves no turn about the vertical between them."""
    R = T_odom_body[:3, :3] @ T_world_body[:3, :3].T
    yaw = np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])
    turn = se3.so3_exp(np.array([0.0, 0.0, yaw]))
    return se3.compose(turn, T_odom_body[:3, 3] - turn @ T_world_body[:3, 3])


def nees(errors: F64, cov: F64) -> F64:
    """Normalised error squared (N,) of errors (N, D) with covariances (N, D, D): D on average, if these are
    right. A covariance of nought makes it infinite."""
    scale = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = errors / scale
        correlation = cov / (scale[:, :, None] * scale[:, None, :])
    known = np.isfinite(correlation).all(axis=(1, 2))
    out = np.full(len(errors), np.inf)
    solved = np.linalg.solve(correlation[known], unit[known][:, :, None])[:, :, 0]
    out[known] = (unit[known] * solved).sum(1)
    return out


def inside(errors: F64, sigmas: F64, times: float = 3.0) -> float:
    """Share of errors (N, D), N >= 1, that are within so many sigmas (N, D) on each axis."""
    return float((np.abs(errors) <= times * sigmas).all(axis=1).mean())
