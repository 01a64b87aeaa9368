"""Pose of a camera from points whose place is known: consensus, then weighted least squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.geometry.absolute_pose import Terms, absolute_pose
from share.types import F64


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """T_cam_world (4, 4), its covariance (6, 6) perturbed on the right, and the inliers (N,) bool."""

    T: F64
    cov: F64
    inliers: NDArray[np.bool_]


def consensus(points: F64, uv: F64, focal: float, threshold_px: float, seed: int) -> PoseEstimate | None:
    """`absolute_pose` of points (N, 3) m, world, seen at uv (N, 2); None without a model."""
    if len(points) < 4:
        return None
    T, inliers = absolute_pose(points, uv, focal, Terms(threshold_px, seed))
    return PoseEstimate(T, np.eye(6), inliers) if inliers.sum() >= 4 else None


def refine(
    T: F64, points: F64, uv: F64, focal: float, sigma_px: F64, gate_px: float, iterations: int = 8
) -> PoseEstimate:
    """Gauss-Newton on reprojection errors with Cauchy weights, from T_cam_world.

    sigma_px (N,): standard deviation of each observation. Points that end further than `gate_px`
    sigmas away are no inliers. The covariance is scaled by the inliers' own residuals, never
    below what `sigma_px` promises.
    """
    scale = focal / sigma_px
    for _ in range(iterations):
        r, J = reprojection(T, points, uv, scale)
        w = 1 / (1 + (r * r).sum(axis=1) / 4.0)  # Cauchy, 2 sigma
        H, g = _normal_equations(r, J, w)
        step: F64 = np.asarray(-np.linalg.solve(H, g), np.float64)
        T = T @ se3.exp(step)
        if np.abs(step).max() < 1e-6:
            break
    r, J = reprojection(T, points, uv, scale)
    squared = (r * r).sum(axis=1)
    inliers = squared < gate_px**2
    H, _ = _normal_equations(r, J, inliers.astype(np.float64))
    excess = squared[inliers].mean() / 2 if inliers.any() else 1.0
    return PoseEstimate(T, np.linalg.inv(H) * max(1.0, excess), inliers)


def _normal_equations(r: F64, J: F64, w: F64) -> tuple[F64, F64]:
    """sum w J'J (6, 6), never quite singular, and sum w J'r (6,)."""
    flat = J.reshape(-1, 6)
    weighted = flat * np.repeat(w, 2)[:, None]
    return weighted.T @ flat + 1e-9 * np.eye(6), weighted.T @ r.ravel()


def reprojection(T: F64, points: F64, uv: F64, scale: F64) -> tuple[F64, F64]:
    """Residuals (N, 2) = scale (projection - uv), and d/d(xi) (N, 2, 6) for T Exp(xi).

    With p_c = R p + t, T Exp(xi) moves it by R (rho - p x phi). So a row d of D R, where D is the
    derivative of the projection, becomes [p x d | d].
    """
    R = T[:3, :3]
    p = points @ R.T + T[:3, 3]
    iz = 1 / np.where(p[:, 2] > 1e-3, p[:, 2], 1e-3)
    projected = p[:, :2] * iz[:, None]
    d = (R[None, :2] - projected[:, :, None] * R[2]) * (iz * scale)[:, None, None]
    J = np.empty((len(p), 2, 6))
    J[:, :, 3:] = d
    x, y, z = points.T[:, :, None]
    J[:, :, 0] = y * d[:, :, 2] - z * d[:, :, 1]
    J[:, :, 1] = z * d[:, :, 0] - x * d[:, :, 2]
    J[:, :, 2] = x * d[:, :, 1] - y * d[:, :, 0]
    return (projected - uv) * scale[:, None], J
