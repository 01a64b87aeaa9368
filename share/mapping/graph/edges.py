"""Edges of a pose graph: residuals and Jacobians of all of them at once.

xi = log(measured^-1 T_a^-1 T_b), perturbations on the right, whitened by W with W'W = cov^-1. Source:
Barfoot, *State Estimation for Robotics* (2017), ch. 7; Grisetti et al., *A Tutorial on Graph-Based SLAM*,
2010.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from share.checks import checked_array, checked_pose
from share.geometry import se3
from share.types import F64, I64


@dataclass(frozen=True, eq=False)
class PoseEdge:
    """A measured relative pose T_a_b (4, 4) with its covariance (6, 6), right perturbation."""

    a: int
    b: int
    T_a_b: F64
    cov: F64

    def __post_init__(self) -> None:
        if self.a == self.b or min(self.a, self.b) < 0:
            raise ValueError(f"edge {self.a} - {self.b}: needs two different poses, numbered from 0")
        object.__setattr__(self, "T_a_b", checked_pose("T_a_b", self.T_a_b))
        object.__setattr__(self, "cov", checked_array("cov", self.cov, (6, 6), np.float64))

    def reverse(self) -> PoseEdge:
        return PoseEdge(self.b, self.a, se3.inverse(self.T_a_b), se3.inverse_cov(self.T_a_b, self.cov))

    @property
    def cov_trace(self) -> float:
        """Trace of the covariance, a scalar measure of uncertainty."""
        return float(self.cov.trace())


# Covariances of odometry, as the graph uses them. Added to the standard deviation of each step: fixed, and
# per rad and m of the step.

_STEP_FLOOR_DEG, _STEP_FLOOR_M = 0.002, 0.0002
_STEP_FLOOR_PER_RAD, _STEP_FLOOR_PER_M = 0.0005, 0.003


def inflate_covariance(T_ref_body: F64, cov: F64) -> F64:
    """Covariance (6, 6) of an odometry step, with a floor that grows with the step added in quadrature.

    `share.mapping.agents.covariance_scales` scales what agents understate.
    """
    return cov + _step_floor(T_ref_body)


def inflate_span(T_earlier_body: F64, cov: F64, steps: int) -> F64:
    """Covariance (6, 6) of odometry over several steps, with the floor of that many equal steps.

    So an agent's spans, which `StatedCovariances` does not see, cannot be certain.
    """
    return cov + steps * _step_floor(T_earlier_body, steps)


def _step_floor(T: F64, steps: int = 1) -> F64:
    """Covariance (6, 6) added to each of `steps` equal steps that make T (4, 4)."""
    angle_rad, length_m = float(se3.rotation_angle(T)) / steps, float(np.linalg.norm(T[:3, 3])) / steps
    rad2 = np.radians(_STEP_FLOOR_DEG) ** 2 + (_STEP_FLOOR_PER_RAD * angle_rad) ** 2
    m2 = _STEP_FLOOR_M**2 + (_STEP_FLOOR_PER_M * length_m) ** 2
    return np.diag([rad2] * 3 + [m2] * 3)


# All edges at once

_MIN_SIGMA = 1e-5  # rad and m; a floor, so that singular covariances are harmless


@dataclass(frozen=True, eq=False)
class EdgeArrays:
    """E edges, indexed like an array. (`ArrayTable` would change the memory layout, and so last digits.)

    Ends a, b (E,); measured T_b_a (E, 4, 4); whitening W (E, 6, 6); cov_trace (E,); is_loop (E,): under the
    robust kernel.
    """

    a: I64
    b: I64
    T_b_a: F64
    whitening: F64
    cov_trace: F64
    is_loop: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.a)

    def __getitem__(self, chosen: Any) -> EdgeArrays:
        return EdgeArrays(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def with_ends(self, a: I64, b: I64) -> EdgeArrays:
        """The same measurements with other indices of their ends."""
        return EdgeArrays(a, b, self.T_b_a, self.whitening, self.cov_trace, self.is_loop)

    def concatenate(self, other: EdgeArrays) -> EdgeArrays:
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return EdgeArrays(*map(np.concatenate, pairs))

    @staticmethod
    def from_measurements(ends: I64, T_a_b: F64, covs: F64, is_loop: NDArray[np.bool_]) -> EdgeArrays:
        """From ends (E, 2), T_a_b (E, 4, 4) and covariances (E, 6, 6)."""
        cov_trace = np.maximum(np.trace(covs, axis1=1, axis2=2), _MIN_SIGMA**2)
        return EdgeArrays(ends[:, 0], ends[:, 1], se3.inverse(T_a_b), _whitening(covs), cov_trace, is_loop)


@dataclass(frozen=True, eq=False)
class EdgeResiduals:
    """Residuals at given poses: T_a_b (E, 4, 4), xi (E, 6), whitened (E, 6), its square chi2 (E,)."""

    T_a_b: F64
    xi: F64
    whitened: F64
    chi2: F64

    def __getitem__(self, chosen: Any) -> EdgeResiduals:
        return EdgeResiduals(self.T_a_b[chosen], self.xi[chosen], self.whitened[chosen], self.chi2[chosen])


def _whitening(covs: F64) -> F64:
    """W (E, 6, 6) with W'W = cov^-1 for covariances (E, 6, 6)."""
    variances, axes = np.linalg.eigh(covs)
    return np.asarray(np.swapaxes(axes, 1, 2) / np.sqrt(np.maximum(variances, _MIN_SIGMA**2))[:, :, None])


def residuals(poses: F64, edges: EdgeArrays) -> EdgeResiduals:
    """Residuals of all edges at poses (N, 4, 4)."""
    T_a_b = se3.inverse(poses)[edges.a] @ poses[edges.b]
    xi = _log(edges.T_b_a @ T_a_b)
    whitened = (edges.whitening @ xi[:, :, None])[:, :, 0]
    return EdgeResiduals(T_a_b, xi, whitened, np.asarray((whitened**2).sum(1)))


def jacobians(residuals_at: EdgeResiduals, edges: EdgeArrays) -> tuple[F64, F64]:
    """Jacobians of the whitened residuals by right perturbations of a and of b, each (E, 6, 6)."""
    by_b = edges.whitening @ _right_jacobian_inverse(residuals_at.xi)
    return -by_b @ se3.adjoint(se3.inverse(residuals_at.T_a_b)), by_b


def _right_jacobian_inverse(xi: F64) -> F64:
    """Map xi (E, 6) to 1 + ad/2 + ad^2/12 (E, 6, 6) (Barfoot eq. 7.79); the next term is ad^4/720."""
    ad = np.zeros((len(xi), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = se3.hat(xi[:, :3])
    ad[:, 3:, :3] = se3.hat(xi[:, 3:])
    return np.asarray(np.eye(6) + ad / 2 + ad @ ad / 12)


def _log(T: F64) -> F64:
    """`se3.log`, (E, 4, 4) -> (E, 6), in a tenth of the time below 90 degrees.

    Larger angles, mostly of false loops, go to `se3.log`.
    """
    R, t = T[:, :3, :3], T[:, :3, 3]
    twice_sine = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1)
    sine = np.linalg.norm(twice_sine, axis=1) / 2
    cosine = (R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1) / 2
    angle = np.arctan2(sine, cosine)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    phi = np.where(small, 0.5, safe / np.maximum(2 * sine, 1e-300))[:, None] * twice_sine
    coefficient = np.where(small, 1 / 12, (1 - safe / 2 / np.tan(safe / 2)) / safe**2)
    phi_cross_t = np.cross(phi, t)
    xi = np.concatenate([phi, t - phi_cross_t / 2 + coefficient[:, None] * np.cross(phi, phi_cross_t)], 1)
    is_large = cosine < 0
    if is_large.any():
        xi[is_large] = se3.log(T[is_large])
    return xi
