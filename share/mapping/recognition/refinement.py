"""Refinement of the relative pose of two cameras from matched keypoints with inverse depths.

A keypoint is y = (u, v, rho): normalised image coordinates and inverse depth [1/m], NaN if unknown. Projected
into the other camera it is y' = h(T, y), and h(T, y_q) - y_c has the covariance N + J N J' with J = dh/dy:
the noise of both detections and both depths counts once. So a match with two depths is one residual of three
rows, not two reprojection errors of two (the four are dependent; their sum would claim twice the
information). Source: the inverse-depth form of Civera et al., T-RO 24(5), 2008; robust Gauss-Newton after
Barfoot (2017), section 5.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.mapping.recognition.relative_tilt import UNKNOWN_TILT, RelativeTilt
from share.types import F64

_RIDGE = 1e-6 * np.eye(6)  # keeps a degenerate set of matches solvable; its covariance is huge
_MIN_DEPTH_M = 0.1  # in front of the camera
_BEHIND_CAMERA_D2 = 1e9  # squared distance of a match that one camera cannot see
_NO_DEPTH_VARIANCE = 1e6  # stands for "no depth", 1/m^2
_SMALL_STEP = 1e-2  # rad and m; below, two unweighted steps follow


@dataclass(frozen=True, eq=False)
class KeypointNoise:
    """Sigmas of a keypoint: `uv` in normalised coordinates, `rho` in 1/m."""

    uv: float
    rho: float

    @property
    def variances(self) -> F64:
        """Variances of u, v and rho, (3,)."""
        return np.array([self.uv, self.uv, self.rho]) ** 2


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """T (4, 4), its covariance (6, 6), and the squared Mahalanobis distance (N,) of each match."""

    T: F64
    cov: F64
    d2: F64


def transfer_keypoints(T: F64, y: F64) -> F64:
    """y' = h(T, y) (3, N) for y (3, N) and T (4, 4), or one T for each (4, 4, N).

    NaN for points behind the camera or without a depth.
    """
    T = T.reshape(4, 4, -1)
    u, v, rho = y
    out = T[:3, 0] * u + T[:3, 1] * v + T[:3, 2] + T[:3, 3] * rho  # the point, times rho
    z = np.where(out[2] > _MIN_DEPTH_M * rho, out[2], np.nan)
    out[2] = rho
    return np.asarray(out / z)


def pose_jacobian(moved: F64) -> F64:
    """dy'/dxi (6, 3, N) for Exp(xi) T, at y' = `moved` (3, N); xi is the first axis."""
    u, v, rho = moved
    out = np.zeros((6, *moved.shape))
    out[0], out[1], out[5] = -v * moved, u * moved, -rho * moved
    out[0, 1] -= 1
    out[1, 0] += 1
    out[2, 0], out[2, 1] = -v, u
    out[3, 0] = out[4, 1] = rho
    return out


def keypoint_jacobian(T: F64, y: F64, moved: F64) -> F64:
    """dy'/dy (3, 3, N), y' = `moved` (3, N); y is the second axis. T as in `transfer_keypoints`."""
    projection = T.reshape(4, 4, -1)[:3, [0, 1, 3]]
    top = projection.copy()
    top[2] = np.array([[0.0], [0.0], [1.0]])
    z = y[2] / moved[2]  # of the point, times rho
    return np.asarray((top - moved[:, None] * projection[2]) / z)


def refine_relative_pose(
    T_c_q: F64,
    y_q: F64,
    y_c: F64,
    noise_q: KeypointNoise,
    noise_c: KeypointNoise,
    gate: float,
    tilt: RelativeTilt = UNKNOWN_TILT,
    iterations: int = 10,
) -> RefinedPose:
    """Refine T_c_q (4, 4) from matched keypoints y_q, y_c (N, 3), each pair with at least one depth, and from
    what is known of the cameras' tilts.

    Geman-McClure weights over all matches until the step is small, then plain least squares over those within
    `gate` (squared Mahalanobis). The covariance is that of the second pass, of the matches scaled by their
    residual variance, at least a quarter.
    """
    problem = _RefinementProblem(y_q, y_c, noise_q, noise_c)
    refined = _refine(T_c_q, problem, gate, tilt, iterations)
    if tilt.contradicts(refined.T):
        refined = _refine(T_c_q, problem, gate, UNKNOWN_TILT, iterations)
    return refined


def _refine(
    T_c_q: F64, problem: _RefinementProblem, gate: float, tilt: RelativeTilt, iterations: int
) -> RefinedPose:
    T, information = T_c_q, problem.information(T_c_q)
    for _ in range(iterations):
        linear = problem.linearise(T, information)
        step = linear.step(1 / (1 + linear.d2 / gate) ** 2, tilt.equations(T))
        T = _apply_twist(step, T)
        if np.abs(step).max() < _SMALL_STEP:
            break
    information = problem.information(T)
    for _ in range(2):
        linear = problem.linearise(T, information)
        is_inlier = linear.d2 < gate
        known = tilt.equations(T)
        T = _apply_twist(linear.step(is_inlier, known), T)
    dof = max(1, int(problem.residual_rows[is_inlier].sum()) - 6)
    variance = max(0.25, float(linear.d2[is_inlier].sum()) / dof)
    adjoint = se3.adjoint(se3.inverse(T))
    cov = np.linalg.inv((linear.normal(is_inlier)[:6, :6] + _RIDGE) / variance + known[0])
    d2 = np.empty(len(linear.d2))
    d2[problem.order] = linear.d2
    return RefinedPose(se3.orthonormal(T), adjoint @ cov @ adjoint.T, d2)


def _apply_twist(xi: F64, T: F64) -> F64:
    """Exp(xi) T to second order, and rigid: Cayley's map, in half the time."""
    X = np.zeros((4, 4))
    X[:3, :3], X[:3, 3] = se3.hat(xi[:3] / 2), xi[3:] / 2
    return np.asarray(np.linalg.solve(np.eye(4) - X, (np.eye(4) + X) @ T))


@dataclass(frozen=True, eq=False)
class _LinearSystem:
    """For each match [J r] (7, 3, N) by Exp(xi) T, the same times its information, and d2 (N,)."""

    Jr: F64
    WJr: F64
    d2: F64

    def normal(self, weight: NDArray[Any]) -> F64:
        """[H g; g' c] (7, 7) of matches weighted by (N,)."""
        return np.asarray(self.Jr.reshape(7, -1) @ (self.WJr * weight).reshape(7, -1).T)

    def step(self, weight: NDArray[Any], known: tuple[F64, F64]) -> F64:
        """Gauss-Newton step (6,) of matches weighted by (N,). known: equations of what else is known."""
        normal, (H, g) = self.normal(weight), known
        return np.asarray(np.linalg.solve(normal[:6, :6] + _RIDGE + H, normal[:6, 6] + g), np.float64)


class _RefinementProblem:
    """Projects matches with a depth in q into c, the others from c into q."""

    def __init__(self, y_q: F64, y_c: F64, noise_q: KeypointNoise, noise_c: KeypointNoise) -> None:
        is_backward = np.isnan(y_q[:, 2])
        self.order = np.argsort(is_backward, kind="stable")
        self._counts = len(is_backward) - int(is_backward.sum()), int(is_backward.sum())
        source, target = np.where(is_backward, (y_c.T, y_q.T), (y_q.T, y_c.T))[:, :, self.order]
        unknown = np.isnan(target[2])
        target[2, unknown] = 0.0
        variances = np.stack([noise_q.variances, noise_c.variances], axis=1)
        self._source, self._noise_source = source, np.repeat(variances, self._counts, axis=1)
        self._target, self._noise_target = target, np.repeat(variances[:, ::-1], self._counts, axis=1)
        self._noise_target[2, unknown] = _NO_DEPTH_VARIANCE
        self.residual_rows = 3.0 - unknown  # of each match

    def _transforms(self, T_c_q: F64) -> F64:
        """Transform of each match, (4, 4, N)."""
        return np.repeat(np.stack([T_c_q, se3.inverse(T_c_q)], axis=2), self._counts, axis=2)

    def information(self, T_c_q: F64) -> F64:
        """Information of each match's residual, (3, 3, N)."""
        T = self._transforms(T_c_q)
        moved = transfer_keypoints(T, self._source)
        J = keypoint_jacobian(T, self._source, moved)
        S = np.einsum("ikn,jkn->ijn", J * self._noise_source, J)
        S[[0, 1, 2], [0, 1, 2]] += self._noise_target
        out = _inverse_symmetric(S)
        out[:, :, np.isnan(moved[2])] = 0.0
        return out

    def linearise(self, T_c_q: F64, information: F64) -> _LinearSystem:
        """Linearise at T_c_q. Rows of points behind the camera are zero."""
        moved = transfer_keypoints(self._transforms(T_c_q), self._source)
        is_behind = np.isnan(moved[2])
        Jr = np.concatenate([pose_jacobian(moved), (self._target - moved)[None]])
        Jr[:, :, is_behind] = 0.0
        forward_count, backward_count = self._counts
        if backward_count:  # (Exp(xi) T)^-1 = Exp(-Ad(T^-1) xi) T^-1
            Ad = se3.adjoint(se3.inverse(T_c_q))
            Jr[:6, :, forward_count:] = (-Ad.T @ Jr[:6, :, forward_count:].reshape(6, -1)).reshape(
                6, 3, backward_count
            )
        WJr = np.einsum("ikn,jkn->jin", information, Jr)
        d2 = (Jr[6] * WJr[6]).sum(0)
        d2[is_behind] = _BEHIND_CAMERA_D2
        return _LinearSystem(Jr, WJr, d2)


def _inverse_symmetric(S: F64) -> F64:
    """Inverse of symmetric matrices (3, 3, N), by cofactors."""
    (a, b, c), (_, d, e), (_, _, f) = S
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    return np.asarray(np.stack([A, B, C, B, D, E, C, E, F]).reshape(S.shape) / (a * A + b * B + c * C))
