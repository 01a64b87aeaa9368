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

_UPRIGHT_STEP_RAD = np.radians(0.001)  # by which a solution turns a map upright: imperceptible
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


def turned_upright(poses: F64, gravity_factors: F64, anchor_index: int) -> F64:
    """Return poses (N, 4, 4) turned about the anchor so that their mean up direction, weighted by its
    information, is the z axis; as they are where none is known."""
    weighted = gravity_factors * np.linalg.norm(gravity_factors, axis=1)[:, None]
    up = (poses[:, :3, :3] @ weighted[:, :, None])[:, :, 0].sum(axis=0)
    axis = np.array([up[1], -up[0], 0.0])  # times the sine of the angle to z
    length = float(np.linalg.norm(axis))
    if not length:
        return poses
    return _turned(poses, axis * (np.arctan2(length, up[2]) / length), anchor_index)


def restore_tilt(poses: F64, before: F64, anchor_index: int) -> F64:
    """Return poses (N, 4, 4) turned about the anchor to the tilt that it had before, (N, 4, 4), but for
    `_UPRIGHT_STEP_RAD`."""
    R_before, R = before[anchor_index, :3, :3], poses[anchor_index, :3, :3]
    if np.array_equal(R_before, R):
        return poses
    turn = se3.so3_log(R_before @ R.T)
    angle = float(np.linalg.norm(turn))
    return _turned(poses, turn * max(0.0, 1 - _UPRIGHT_STEP_RAD / angle), anchor_index)


def _turned(poses: F64, rotation: F64, anchor_index: int) -> F64:
    """Return poses turned by a rotation (3,) rad about the anchor, in the map's axes."""
    R, pivot = se3.so3_exp(rotation), poses[anchor_index, :3, 3]
    out = poses.copy()
    out[:, :3, :3] = R @ poses[:, :3, :3]
    out[:, :3, 3] = pivot + (poses[:, :3, 3] - pivot) @ R.T  # the anchor's position stays to the bit
    return out


def tilt_projector(pose: F64) -> F64:
    """Projector (6, 6) of right perturbations of `pose` (4, 4) to rotations about horizontal axes."""
    horizontal_axes = pose[:2, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = horizontal_axes.T @ horizontal_axes
    return out


def _gravity_residual(poses: F64, gravity_factors: F64) -> F64:
    """Whitened residuals (N, 2)."""
    return np.asarray((poses[:, :2, :3] @ gravity_factors[:, :, None])[:, :, 0])
