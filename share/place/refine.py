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
from share.geometry.camera import rays
from share.types import F64

Mask = NDArray[np.bool_]

_RIDGE = 1e-6 * np.eye(6)  # keeps a hopeless set of matches solvable; its covariance says so
_NEAREST = 0.1  # m before the camera
_NOT_SEEN = 1e9  # squared distance of a match that one camera cannot see
_UNKNOWN = 1e6  # variance that stands for "no depth", 1/m^2


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


def move(T: F64, y: F64) -> tuple[F64, F64, F64]:
    """y' = h(T, y) for T (4, 4) and y (N, 3); dh/dxi (N, 3, 6) for T Exp(xi); dh/dy (N, 3, 3).

    NaN for a point that is then behind the camera: it has no image.
    """
    rho = y[:, 2]
    points = rays(y[:, :2]) / rho[:, None]
    x, yy, z = se3.transform(T, points).T
    z = np.where(z > _NEAREST, z, np.nan)
    moved = np.stack([x / z, yy / z, 1 / z], axis=1)
    project = np.zeros((len(y), 3, 3))
    project[:, 0, 0] = project[:, 1, 1] = 1 / z
    project[:, 0, 2], project[:, 1, 2], project[:, 2, 2] = -x / z**2, -yy / z**2, -1 / z**2
    project = project @ T[:3, :3]
    by_pose = np.concatenate([-project @ se3.hat(points), project], axis=2)
    unproject = np.zeros((len(y), 3, 3))
    unproject[:, 0, 0] = unproject[:, 1, 1] = 1 / rho
    unproject[:, :, 2] = -points / rho[:, None]
    return moved, by_pose, project @ unproject


def refine(
    T_c_q: F64, y_q: F64, y_c: F64, noise_q: Noise, noise_c: Noise, gate: float, iterations: int = 10
) -> Refined:
    """Refine T_c_q (4, 4) from matched keypoints y_q, y_c (N, 3), each with at least one depth.

    Geman-McClure weights over all matches until the step is small, then plain least squares over those
    within `gate` (squared Mahalanobis). The covariance is that of the second pass, scaled by its
    residual variance; a scale below one is believed down to a quarter.
    """
    T = T_c_q
    for _ in range(iterations):
        whole = _linearise(T, y_q, y_c, noise_q, noise_c)
        step = _solve(whole, 1 / (1 + whole.d2 / gate) ** 2)
        T = T @ se3.exp(step)
        if np.abs(step).max() < 1e-4:  # rad and m; two plain steps follow
            break
    for _ in range(2):
        whole = _linearise(T, y_q, y_c, noise_q, noise_c)
        inside = whole.d2 < gate
        T = T @ se3.exp(_solve(whole, inside))
    freedom = max(1, int(whole.rows[inside].sum()) - 6)
    variance = max(0.25, float(whole.d2[inside].sum()) / freedom)
    return Refined(se3.orthonormal(T), np.linalg.inv(whole.H[inside].sum(0) + _RIDGE) * variance, whole.d2)


@dataclass(frozen=True, eq=False)
class _Linear:
    """Per match: information H (N, 6, 6), gradient g (N, 6), d2 (N,), and rows that it measures (N,)."""

    H: F64
    g: F64
    d2: F64
    rows: F64


def _linearise(T_c_q: F64, y_q: F64, y_c: F64, noise_q: Noise, noise_c: Noise) -> _Linear:
    """Matches with a depth in q are moved into c, the others from c into q."""
    forward = np.isfinite(y_q[:, 2])
    n = len(y_q)
    out = _Linear(np.zeros((n, 6, 6)), np.zeros((n, 6)), np.zeros(n), np.zeros(n))
    _add(out, forward, T_c_q, y_q, y_c, noise_q, noise_c, np.eye(6))
    # (T Exp(xi))^-1 = T^-1 Exp(-Ad(T) xi)
    _add(out, ~forward, se3.inverse(T_c_q), y_c, y_q, noise_c, noise_q, -se3.adjoint(T_c_q))
    return out


def _add(
    out: _Linear, mask: Mask, T: F64, source: F64, target: F64, noise_s: Noise, noise_t: Noise, by_xi: F64
) -> None:
    moved, J, by_source = move(T, source[mask])
    seen = np.isfinite(moved[:, 2])
    out.d2[np.flatnonzero(mask)[~seen]] = _NOT_SEEN
    at = np.flatnonzero(mask)[seen]
    target, moved, J, by_source = target[at], moved[seen], J[seen] @ by_xi, by_source[seen]
    known = np.isfinite(target[:, 2])
    r = np.where(np.isfinite(target), target - moved, 0.0)
    S = by_source * noise_s.variances @ np.swapaxes(by_source, 1, 2)
    S[:, [0, 1, 2], [0, 1, 2]] += noise_t.variances
    S[~known, 2, 2] += _UNKNOWN
    WJr = np.linalg.solve(S, np.concatenate([J, r[:, :, None]], axis=2))
    normal = np.swapaxes(J, 1, 2) @ WJr
    out.H[at], out.g[at] = normal[:, :, :6], normal[:, :, 6]
    out.d2[at] = (r * WJr[:, :, 6]).sum(1)
    out.rows[at] = 2 + known


def _solve(linear: _Linear, weight: NDArray[Any]) -> F64:
    H = np.tensordot(weight.astype(np.float64), linear.H, 1)
    return np.asarray(np.linalg.solve(H + _RIDGE, weight @ linear.g), np.float64)
