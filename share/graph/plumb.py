"""Which way is up at a pose, as its agent's IMU knows it: what a plumb line says there.

plumb (N, 3): the unit vector against gravity in the body, divided by its sigma (rad), zeros where unknown.
z of the map is up, so the whitened residual of a pose with rotation R is what is not vertical of it: the
first two rows of R plumb. Of a perturbation Exp(xi) on the right its derivative is -(R [plumb]x). Source:
Usenko et al., *Visual-Inertial Mapping with Non-Linear Factor Recovery*, RA-L 2020, the roll-pitch factor.
"""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.types import F64


def cost(poses: F64, plumb: F64) -> float:
    """Sum of the squared residuals at poses (N, 4, 4)."""
    return float((_residual(poses, plumb) ** 2).sum())


def equations(poses: F64, plumb: F64) -> tuple[F64, F64]:
    """Slope (N, 6) and curvature (N, 6, 6) of half the cost by each pose's own perturbation."""
    J = -(poses[:, :2, :3] @ se3.hat(plumb))
    slope, curvature = np.zeros((len(poses), 6)), np.zeros((len(poses), 6, 6))
    slope[:, :3] = (np.swapaxes(J, 1, 2) @ _residual(poses, plumb)[:, :, None])[:, :, 0]
    curvature[:, :3, :3] = np.swapaxes(J, 1, 2) @ J
    return slope, curvature


def tilting(pose: F64) -> F64:
    """Projector (6, 6) of a perturbation of `pose` (4, 4) on its turns about level axes."""
    level = pose[:2, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = level.T @ level
    return out


def _residual(poses: F64, plumb: F64) -> F64:
    """(N, 2)."""
    return np.asarray((poses[:, :2, :3] @ plumb[:, :, None])[:, :, 0])
