"""The relative pose of two cameras that see the same points, refined, with an honest covariance.

A keypoint is y = (u, v, rho): where it is seen (normalised coordinates) and its inverse depth
[1/m], NaN if unknown. Moving it into the other camera gives y' = h(T, y), and h(T, y_q) - y_c has
the covariance N + J N J' with J = dh/dy: noise of both detections and of both depths is counted
once. That is why a match with two depths enters as one residual of three rows, not as two
reprojection errors of two (the four are dependent; summing them would claim twice the
information). Source: the inverse-depth form of Civera et al., T-RO 24(5), 2008; robust
Gauss-Newton after Barfoot (2017), section 5.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from share.geometry import se3
from share.types import F64, I64

_RIDGE = 1e-6 * np.eye(6)  # keeps a hopeless set of matches solvable; its covariance says so
_NEAREST = 0.1  # m before the camera
_NOT_SEEN = 1e9  # squared distance of a match that one camera cannot see
_UNKNOWN = 1e6  # variance that stands for "no depth", 1/m^2
_SMALL = 1e-3  # rad and m; after a step so small, two plain ones follow


@dataclass(frozen=True, eq=False)
class Noise:
    """One sigma of a keypoint: `uv` in normalised coordinates, `rho` in 1/m."""

    uv: float
    rho: float

    @property
    def variances(self) -> F64:
        """(3,), of u, v and rho."""
        return np.array([self.uv, self.uv, self.rho]) ** 2


@dataclass(frozen=True, eq=False)
class Refined:
    """T (4, 4), its covariance (6, 6) and the squared Mahalanobis distance (N,) of each match."""

    T: F64
    cov: F64
    d2: F64


def move(T: F64, y: F64) -> F64:
    """y' = h(T, y) (N, 3) for T (4, 4) and y (N, 3); NaN for a point that is then behind the camera:
    it has no image, and for one without a depth."""
    rho = y[:, 2:]
    scaled = y[:, :2] @ T[:3, :2].T + T[:3, 2] + rho * T[:3, 3]  # the point, times rho
    z = scaled[:, 2:]
    z = np.where(z > _NEAREST * rho, z, np.nan)
    return np.concatenate([scaled[:, :2], rho], axis=1) / z


def by_pose(moved: F64) -> F64:
    """dy'/dxi (N, 3, 6) for Exp(xi) T, at y' = `moved` (N, 3)."""
    u, v, rho = moved.T
    out = np.zeros((len(moved), 3, 6))
    by_u, by_v, by_rho = out[:, 0], out[:, 1], out[:, 2]
    out[:, :, 5] = -rho[:, None] * moved
    by_u[:, 3] = by_v[:, 4] = rho
    by_u[:, 2], by_v[:, 2] = -v, u
    by_v[:, 1] = u * v
    by_u[:, 0], by_u[:, 1] = -by_v[:, 1], 1 + u * u
    by_v[:, 0] = -1 - v * v
    by_rho[:, 0], by_rho[:, 1] = -rho * v, rho * u
    return out


def by_keypoint(T: F64, y: F64, moved: F64) -> F64:
    """dy'/dy (N, 3, 3), y' = `moved` (N, 3)."""
    into = np.column_stack([T[:3, :2], T[:3, 3]])
    top = np.stack([into[0], into[1], np.array([0.0, 0.0, 1.0])])
    z = y[:, 2] / moved[:, 2]  # of the point, times rho
    return np.asarray((top - moved[:, :, None] * into[2]) / z[:, None, None])


def refine(
    T_c_q: F64, y_q: F64, y_c: F64, noise_q: Noise, noise_c: Noise, gate: float, iterations: int = 10
) -> Refined:
    """Refine T_c_q (4, 4) from matched keypoints y_q, y_c (N, 3), each with at least one depth.

    Geman-McClure weights over all matches until the step is small, then plain least squares over those
    within `gate` (squared Mahalanobis). The covariance is that of the second pass, scaled by its
    residual variance; a scale below one is believed down to a quarter.
    """
    problem = _Problem(y_q, y_c, noise_q, noise_c)
    T, information = T_c_q, problem.information(T_c_q)
    for _ in range(iterations):
        linear = problem.linear(T, information)
        step = linear.step(1 / (1 + linear.d2 / gate) ** 2)
        T = se3.exp(step) @ T
        if np.abs(step).max() < _SMALL:
            break
    information = problem.information(T)
    for _ in range(2):
        linear = problem.linear(T, information)
        inside = linear.d2 < gate
        T = se3.exp(linear.step(inside)) @ T
    freedom = max(1, int(problem.rows[inside].sum()) - 6)
    variance = max(0.25, float(linear.d2[inside].sum()) / freedom)
    to_right = se3.adjoint(se3.inverse(T))
    cov = np.linalg.inv(linear.normal(inside)[:6, :6] + _RIDGE) * variance
    return Refined(se3.orthonormal(T), to_right @ cov @ to_right.T, linear.d2)


@dataclass(frozen=True, eq=False)
class _Linear:
    """Per match: [J r] (N, 3, 7) by Exp(xi) T, the same times its information, and d2 (N,)."""

    Jr: F64
    WJr: F64
    d2: F64

    def normal(self, weight: NDArray[Any]) -> F64:
        """[H g; g' c] (7, 7) of matches weighted by (N,)."""
        weighted = self.WJr * weight[:, None, None]
        return np.asarray(self.Jr.reshape(-1, 7).T @ weighted.reshape(-1, 7))

    def step(self, weight: NDArray[Any]) -> F64:
        normal = self.normal(weight)
        return np.asarray(np.linalg.solve(normal[:6, :6] + _RIDGE, normal[:6, 6]), np.float64)


class _Problem:
    """Matches with a depth in q are moved into c, the others from c into q."""

    def __init__(self, y_q: F64, y_c: F64, noise_q: Noise, noise_c: Noise) -> None:
        forward = np.isfinite(y_q[:, 2])
        there, back = np.flatnonzero(forward), np.flatnonzero(~forward)
        self.rows = 2.0 + (forward & np.isfinite(y_c[:, 2]))  # that each match measures
        self._ways = [
            _Way(there, y_q[there], y_c[there], noise_q.variances, noise_c.variances),
            _Way(back, y_c[back], y_q[back], noise_c.variances, noise_q.variances),
        ]

    def information(self, T_c_q: F64) -> F64:
        """Of every match's residual, (N, 3, 3)."""
        out = np.zeros((len(self.rows), 3, 3))
        for way, T in zip(self._ways, (T_c_q, se3.inverse(T_c_q)), strict=True):
            out[way.at] = way.information(T)
        return out

    def linear(self, T_c_q: F64, information: F64) -> _Linear:
        back = se3.inverse(T_c_q)
        Jr = np.zeros((len(self.rows), 3, 7))
        Jr[self._ways[0].at] = self._ways[0].linear(T_c_q)
        if len(self._ways[1].at):  # (Exp(xi) T)^-1 = Exp(-Ad(T^-1) xi) T^-1
            there = self._ways[1].linear(back)
            there[:, :, :6] = there[:, :, :6] @ -se3.adjoint(back)
            Jr[self._ways[1].at] = there
        WJr = information @ Jr
        d2 = (Jr[:, :, 6] * WJr[:, :, 6]).sum(1)
        d2[Jr[:, 0, 3] == 0] = _NOT_SEEN
        return _Linear(Jr, WJr, d2)


@dataclass(frozen=True, eq=False)
class _Way:
    """Matches `at` (N,) whose source keypoints (N, 3), all with depth, move into the targets' camera."""

    at: I64
    source: F64
    target: F64
    noise_source: F64
    noise_target: F64

    def information(self, T: F64) -> F64:
        moved = move(T, self.source)
        J = by_keypoint(T, self.source, moved)
        S = J * self.noise_source @ np.swapaxes(J, 1, 2)
        S[:, [0, 1, 2], [0, 1, 2]] += self.noise_target
        S[np.isnan(self.target[:, 2]), 2, 2] += _UNKNOWN
        S[np.isnan(moved[:, 2])] = np.eye(3)
        return np.asarray(np.linalg.inv(S))

    def linear(self, T: F64) -> F64:
        """[J r] (N, 3, 7) by Exp(xi) T; zeros for a point behind the camera: its rows count for nothing."""
        moved = move(T, self.source)
        r = self.target - moved
        r[np.isnan(self.target[:, 2]), 2] = 0.0
        out = np.concatenate([by_pose(moved), r[:, :, None]], axis=2)
        out[np.isnan(moved[:, 2])] = 0.0
        return out
