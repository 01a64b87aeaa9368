"""Relative scale of two cameras' depths, from one pair of views.

Both views know the depth of a matched point. If all depths of the query are too large by e^l, its inverse
depths are too small by it, so y' = h(T, (u, v, rho e^l)) has to match y_c: the residual of
`share.mapping.recognition.refinement` with one more unknown. A wrong stereo baseline and a wrong focal length
both show here. A pose estimated as if both had one scale is off by some mm per percent and metre of depth:
see `DepthScale.pose_sensitivity`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from share.geometry import se3
from share.mapping.recognition.refinement import (
    KeypointNoise,
    keypoint_jacobian,
    pose_jacobian,
    transfer_keypoints,
)
from share.types import F64

_MIN_MATCHES = 10  # with both depths
_ITERATIONS = 2
_MAX_LOG_SCALE = 1.0  # beyond, the matches are wrong
_RIDGE = 1e-6 * np.eye(7)


class DepthScale(NamedTuple):
    """Log of the query's depths over the candidate's, with its sigma.

    pose_sensitivity (6,): left perturbation of T_c_q per unit of log that is corrected; None if unknown.
    shared_sigma: of the error that all depths of a view have in common; it does not average out over points,
    nor over views of the same time.
    """

    log: float
    sigma: float
    pose_sensitivity: F64 | None = None
    shared_sigma: float = 0.0

    def reverse(self) -> DepthScale:
        """Return the scale with query and candidate exchanged; the pose sensitivity is dropped."""
        return DepthScale(-self.log, self.sigma, None, self.shared_sigma)


def relative_depth_scale(
    T_c_q: F64, y_q: F64, y_c: F64, noise_q: KeypointNoise, noise_c: KeypointNoise, gate: float
) -> DepthScale | None:
    """Relative depth scale from the refined T_c_q (4, 4) of the cameras and matches y_q, y_c (N, 3).

    Depths are NaN where unknown. gate: squared Mahalanobis distance of an inlier. None where too few matches
    have both depths. Raises LinAlgError where they do not determine it.
    """
    has_both_depths = np.isfinite(y_q[:, 2]) & np.isfinite(y_c[:, 2])
    source, target = y_q[has_both_depths].T, y_c[has_both_depths].T
    T, log_scale = T_c_q, 0.0
    for _ in range(_ITERATIONS):
        J, information, residual = _linearise(T, log_scale, source, target, noise_q, noise_c)
        WJ = information @ J
        d2 = (residual * (information @ residual[:, :, None])[:, :, 0]).sum(1)
        is_inlier = d2 < gate
        if is_inlier.sum() < _MIN_MATCHES:
            return None
        J, WJ, residual = J[is_inlier], WJ[is_inlier], residual[is_inlier]
        J, WJ = J.reshape(-1, 7), WJ.reshape(-1, 7)
        normal = J.T @ WJ + _RIDGE
        step = np.linalg.solve(normal, WJ.T @ residual.ravel())
        T, log_scale = se3.exp(step[:6]) @ T, log_scale + float(step[6])
    if not abs(log_scale) < _MAX_LOG_SCALE:
        return None
    variance = max(1.0, float(d2[is_inlier].sum()) / max(1, 3 * int(is_inlier.sum()) - 7))
    pose_sensitivity = -np.linalg.solve(normal[:6, :6], normal[:6, 6])
    return DepthScale(log_scale, float(np.sqrt(np.linalg.inv(normal)[6, 6] * variance)), pose_sensitivity)


def fitted_depth_scale(J: F64, r: F64, log_scales: F64) -> tuple[float, float]:
    """Return the log of the query's depths over the candidate's, and its sigma, with nothing known of it
    before, at the fit of a pose and both logs to whitened residuals r (M, 2). J (M, 2, 8): their
    derivatives; log_scales (2,)."""
    A = J[:, :, :7].reshape(-1, 7)
    normal = A.T @ A + _RIDGE
    log_scale = float(log_scales[0] - log_scales[1] + np.linalg.solve(normal, A.T @ r.ravel())[6])
    variance = max(1.0, float((r * r).sum()) / max(1, 2 * len(r) - 7))
    return log_scale, float(np.sqrt(np.linalg.inv(normal)[6, 6] * variance))


def _linearise(
    T: F64, log_scale: float, source: F64, target: F64, noise_q: KeypointNoise, noise_c: KeypointNoise
) -> tuple[F64, F64, F64]:
    """J (N, 3, 7), information (N, 3, 3) and residual (N, 3); zero for points behind the camera."""
    y = source.copy()
    y[2] *= np.exp(log_scale)
    moved = transfer_keypoints(T, y)
    K = keypoint_jacobian(T, y, moved)  # (3, 3, N)
    J = np.concatenate([pose_jacobian(moved), (K[:, 2] * y[2])[None]]).transpose(2, 1, 0)
    dy = K.transpose(2, 0, 1)
    covariance = (dy * noise_q.variances) @ dy.swapaxes(1, 2) + np.diag(noise_c.variances)
    residual = (target - moved).T
    is_visible = np.isfinite(moved.sum(0))
    J, residual = np.where(is_visible[:, None, None], J, 0.0), np.where(is_visible[:, None], residual, 0.0)
    information = np.zeros_like(covariance)
    information[is_visible] = np.linalg.inv(covariance[is_visible])
    return J, information, residual
