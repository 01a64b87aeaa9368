"""Gravity factors: the up direction that an agent's IMU measured at a pose.

A factor (3,) is the unit vector against gravity in the body frame, divided by its sigma (rad); zeros where
unknown. The map's z axis is up, so the whitened residual of a pose with rotation R is the horizontal part of
R @ factor, its first two rows. The derivative by a right perturbation Exp(xi) is -(R [factor]x). Source: the
roll-pitch factor of Usenko et al., *Visual-Inertial Mapping with Non-Linear Factor Recovery*, RA-L 2020.
"""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.types import F64, Keyframe

_FLOOR_DEG = 0.1  # added to sigma in quadrature: error of the IMU calibration


def make_gravity_factor(keyframe: Keyframe) -> F64:
    """Return a keyframe's factor (3,). Sigma has a floor: that of the calibration of camera and IMU."""
    norm = float(np.linalg.norm(keyframe.up))
    sigma = np.hypot(keyframe.up_sigma, np.radians(_FLOOR_DEG))
    return keyframe.up / (norm * sigma) if norm else np.zeros(3)


def gravity_cost(poses: F64, gravity_factors: F64) -> float:
    """Sum of squared residuals at poses (N, 4, 4)."""
    return float((_gravity_residual(poses, gravity_factors) ** 2).sum())


def gravity_equations(poses: F64, gravity_factors: F64) -> tuple[F64, F64]:
    """Gradient (N, 6) and Hessian (N, 6, 6) of half the cost by each pose's right perturbation."""
    J = -(poses[:, :2, :3] @ se3.hat(gravity_factors))
    gradient, hessian = np.zeros((len(poses), 6)), np.zeros((len(poses), 6, 6))
    gradient[:, :3] = (np.swapaxes(J, 1, 2) @ _gravity_residual(poses, gravity_factors)[:, :, None])[:, :, 0]
    hessian[:, :3, :3] = np.swapaxes(J, 1, 2) @ J
    return gradient, hessian


def tilt_projector(pose: F64) -> F64:
    """Projector (6, 6) of right perturbations of `pose` (4, 4) to rotations about horizontal axes."""
    horizontal_axes = pose[:2, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = horizontal_axes.T @ horizontal_axes
    return out


def _gravity_residual(poses: F64, gravity_factors: F64) -> F64:
    """Whitened residuals (N, 2)."""
    return np.asarray((poses[:, :2, :3] @ gravity_factors[:, :, None])[:, :, 0])
