"""Comparison of two agents' odometry and depths, by the loops between them.

Each loop i between keyframes a of one segment and b of another measures the pose of the second odometry frame
in the first: Z = T_a T_a_b T_b^-1, with T_a, T_b relative to the starts of their segments. If both agents are
right, all Z equal one pose G, up to the noise of the loops and the random walks of both odometries, which two
loops share as far as both have walked. In left perturbations, xi = log(Z G^-1), the walks simply add up:

    cov(xi_i, xi_j) = P_a(min) + Ad_G P_b(min) Ad_G' + [i = j] Ad_(G T_b) S_i Ad_(G T_b)',   P(k) = sum to k

Possible errors of the agents are further unknowns of these equations: a path longer by e^l than the other's
moves xi by -l times the position of the loop; a camera rotated on its body by phi rotates it by Ad_(G T_b)
(phi, 0). Generalised least squares estimates each with its sigma; loops are under a Cauchy kernel, since some
are false. The median residual noise of the loops, per degree of freedom, shows whether the covariances are
too small. Source: Barfoot, *State Estimation for Robotics* (2017), chapters 5 and 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from share.geometry import se3
from share.mapping.recognition.depth_scale import DepthScale
from share.types import F64, I64

_ODOMETRY_SIGMA_SCALE = 2.0  # by which the odometry sigmas of good agents are too small at most
_LOOP_SIGMA_SCALE = 1.3  # the same for loops
_CAUCHY_WIDTH_SQUARED = 12.0  # of 6 dof
_IRLS_ITERATIONS = 6
_CHI2_6DOF_MEDIAN = 5.35
_PRIOR_SIGMAS = np.array([0.2, 0.1, 0.1, 0.1])  # log scale, rad; so that two loops have a solution
_MAD_PER_SIGMA = 0.6745  # median of |x| of a standard normal distribution
# A loop that deviates by more is not noisy: it joins two places that look alike.
_SAME_PLACE_M, _SAME_PLACE_RAD = 1.0, 0.5
_MIN_INLIER_WEIGHT = 0.3  # of a loop that fits
_LOG_SCALE_FLOOR = 0.004  # added sigma of one loop's depth scale: occlusions, pixels
_AS_STATED = (1.0, 1.0)
_MIN_SCALE_SIGMA = 0.003  # of log scales: no two agents are calibrated better


@dataclass(frozen=True, eq=False)
class AccumulatedOdometry:
    """Odometry from a segment's start to its keyframe `index`: T (4, 4), cov (6, 6), left perturbation."""

    index: int
    T: F64
    cov: F64

    @staticmethod
    def origin() -> AccumulatedOdometry:
        """At the first keyframe of a segment."""
        return AccumulatedOdometry(0, np.eye(4), np.zeros((6, 6)))

    def with_step(self, T_ref_body: F64, cov: F64) -> AccumulatedOdometry:
        """Append a step with cov (6, 6), right perturbation."""
        T = se3.orthonormal(self.T @ T_ref_body)
        Ad = se3.adjoint(T)
        return AccumulatedOdometry(self.index + 1, T, self.cov + Ad @ cov @ Ad.T)


@dataclass(frozen=True, eq=False)
class InterAgentLoop:
    """A loop between two agents: T_a_b (4, 4), cov (6, 6), and the accumulated odometry of both ends.

    depth_scale: of b's depths relative to a's. tilt: angle between both up directions and its sigma, rad;
    None where gravity is unknown.
    """

    a: AccumulatedOdometry
    b: AccumulatedOdometry
    T_a_b: F64
    cov: F64
    depth_scale: DepthScale | None = None
    tilt: tuple[float, float] | None = None


@dataclass(frozen=True)
class ScalarEstimate:
    """An estimate from `count` loops."""

    value: float
    sigma: float
    count: int

    @property
    def significance(self) -> float:
        return abs(self.value) / self.sigma


@dataclass(frozen=True, eq=False)
class OdometryComparison:
    """Comparison of b with a.

    path_scale: log of how much longer b's path is. camera_rotation: of the camera on its body, rad. nis: of
    the loops' remaining noise, 1 if covariances are right. weights (N,): of the loops under the kernel.
    """

    path_scale: ScalarEstimate
    camera_rotation: ScalarEstimate
    nis: float
    weights: F64

    @property
    def inlier_share(self) -> float:
        return float((self.weights > _MIN_INLIER_WEIGHT).mean())


@dataclass(frozen=True, eq=False)
class ComparisonEquations:
    """Equations of N loops between two segments.

    xi (N, 6); J (N, 6, 10): derivative by G, the path's log scale and the camera's rotation; and the parts of
    the covariance, as stated by the agents: either random walk (N, 6, N, 6), each loop's own noise (N, 6, 6).
    """

    xi: F64
    J: F64
    walk_cov_a: F64
    walk_cov_b: F64
    loop_cov: F64


def robust_depth_scale(scales: Sequence[DepthScale]) -> ScalarEstimate:
    """Robust mean of at least one log scale. sigma: from their scatter if that is larger.

    The error that the depths of a view share may last: in the mean it counts with its least value, that of
    the view which knows its scale best.
    """
    logs = np.array([s.log for s in scales])
    shared_variance = np.array([s.shared_sigma for s in scales]) ** 2
    variance = np.array([s.sigma for s in scales]) ** 2 + shared_variance + _LOG_SCALE_FLOOR**2
    mean, weight = float(np.median(logs)), np.ones(len(logs))
    mad_variance = float(np.median(np.abs(logs - mean)) / _MAD_PER_SIGMA) ** 2
    variance = variance * max(1.0, mad_variance / float(np.median(variance)))
    for _ in range(_IRLS_ITERATIONS):
        weight = 1 / (1 + (logs - mean) ** 2 / (4 * variance))
        mean = float((weight * logs / variance).sum() / (weight / variance).sum())
    information = weight / variance
    scatter = float((information**2 * (logs - mean) ** 2).sum()) ** 0.5
    spread = scatter / float(information.sum())  # Huber's sandwich
    lasting = max(_MIN_SCALE_SIGMA, float(shared_variance.min()) ** 0.5)
    return ScalarEstimate(mean, float(np.hypot(max(information.sum() ** -0.5, spread), lasting)), len(logs))


def compare_odometry(
    loops: Sequence[InterAgentLoop], covariance_scales: tuple[float, float] = _AS_STATED
) -> OdometryComparison:
    """Compare by at least three loops of the same two segments: see `solve_comparison`."""
    return solve_comparison(comparison_equations(loops), covariance_scales)


def comparison_equations(loops: Sequence[InterAgentLoop]) -> ComparisonEquations:
    """Equations of loops between the same two segments, about the centre of their positions."""
    ends = ((loop.a.T, loop.b.T, loop.T_a_b) for loop in loops)
    T_a, T_b, T_a_b = (np.array(x) for x in zip(*ends, strict=True))
    T_centre = np.eye(4)
    T_centre[:3, 3] = -(T_a @ T_a_b)[:, :3, 3].mean(0)
    Ad = se3.adjoint(T_centre)
    T_a = T_centre @ T_a
    G = _consensus_pose(T_a @ T_a_b @ se3.inverse(T_b))
    walk_cov_a = _shared_walk_cov([loop.a for loop in loops], Ad)
    walk_cov_b = _shared_walk_cov([loop.b for loop in loops], se3.adjoint(G))
    Ad_loop = se3.adjoint(T_a @ T_a_b)
    loop_cov = Ad_loop @ np.array([loop.cov for loop in loops]) @ Ad_loop.swapaxes(1, 2)
    xi = se3.log(T_a @ T_a_b @ se3.inverse(T_b) @ se3.inverse(G))
    return ComparisonEquations(xi, _jacobian(T_a @ T_a_b), walk_cov_a, walk_cov_b, loop_cov)


def _consensus_pose(Z: F64) -> F64:
    """The one of N poses that agrees with most others."""
    xi = se3.log((Z[:, None] @ se3.inverse(Z)[None]).reshape(-1, 4, 4)).reshape(len(Z), len(Z), 6)
    distance = np.minimum(1.0, np.linalg.norm(xi * (10, 10, 10, 1, 1, 1), axis=2))
    return np.asarray(Z[distance.sum(1).argmin()])


def _shared_walk_cov(accumulated: Sequence[AccumulatedOdometry], Ad: F64) -> F64:
    """Covariance (N, 6, N, 6) that N loops share through one side's random walk since the first of them."""
    indices: I64 = np.array([loop.index for loop in accumulated])
    P = np.array([loop.cov for loop in accumulated])
    P = Ad @ (P - P[indices.argmin()]) @ Ad.T
    earlier = np.where(indices[:, None] <= indices, np.arange(len(indices))[:, None], np.arange(len(indices)))
    return np.asarray(P[earlier].transpose(0, 2, 1, 3))


def _jacobian(T_b: F64) -> F64:
    """Derivative (N, 6, 10) of xi by G, the path's log scale and the camera's rotation."""
    out = np.zeros((len(T_b), 6, 10))
    out[:, :, :6] = np.eye(6)
    out[:, 3:, 6] = -T_b[:, :3, 3]
    out[:, :, 7:] = se3.adjoint(T_b)[:, :, :3]
    return out


def solve_comparison(
    equations: ComparisonEquations, covariance_scales: tuple[float, float] = _AS_STATED
) -> OdometryComparison:
    """Estimate the differences between two agents.

    covariance_scales: factors on the variances of either random walk in the estimate of the camera's
    rotation; otherwise, with loops at few places, the noise of an agent that understates its covariance looks
    like a rotation. The path scale uses the stated covariances: a path that is too long and too certain bends
    other maps, and is detected sooner. Raises LinAlgError where absurd numbers leave no solution.
    """
    as_stated = _solve(equations, _AS_STATED)
    if covariance_scales == _AS_STATED:
        return as_stated
    return replace(as_stated, camera_rotation=_solve(equations, covariance_scales).camera_rotation)


def _solve(e: ComparisonEquations, covariance_scales: tuple[float, float]) -> OdometryComparison:
    xi, J, n = e.xi, e.J, len(e.xi)
    scale_a, scale_b = covariance_scales
    walk_cov = _ODOMETRY_SIGMA_SCALE**2 * (scale_a * e.walk_cov_a + scale_b * e.walk_cov_b)
    loop_cov = _LOOP_SIGMA_SCALE**2 * e.loop_cov
    rows, prior = J.reshape(6 * n, 10), np.zeros((10, 10))
    equations = np.column_stack([rows, xi.ravel()])
    prior[range(6, 10), range(6, 10)] = _PRIOR_SIGMAS**-2
    loop_information, weight = np.linalg.inv(loop_cov), np.ones(n)
    for _ in range(_IRLS_ITERATIONS):
        C = walk_cov.copy()
        C[range(n), :, range(n)] += loop_cov / weight[:, None, None]
        whitened = np.linalg.solve(C.reshape(6 * n, 6 * n), equations)  # times the information
        normal = rows.T @ whitened[:, :10] + prior
        theta = np.linalg.solve(normal, rows.T @ whitened[:, 10])
        residual = xi.ravel() - rows @ theta
        weighted = (whitened[:, 10] - whitened[:, :10] @ theta).reshape(n, 6)
        noise = (loop_cov @ weighted[:, :, None])[:, :, 0] / weight[:, None]  # the loops' part of it
        chi2 = np.einsum("ni,nij,nj->n", noise, loop_information, noise)
        weight = 1 / (1 + chi2 / _CAUCHY_WIDTH_SQUARED)
    is_same_place = (np.abs(residual.reshape(n, 6)) < [_SAME_PLACE_RAD] * 3 + [_SAME_PLACE_M] * 3).all(axis=1)
    nis = float(np.median(chi2[is_same_place])) / _CHI2_6DOF_MEDIAN if is_same_place.any() else 0.0
    misfit = float(residual @ weighted.ravel()) / max(1, 6 * n - 10)  # shows a wrong model
    cov = np.linalg.inv(normal) * max(1.0, nis, misfit)
    rotation = theta[7:]
    chi = max(1e-6, float(rotation @ np.linalg.solve(cov[7:, 7:], rotation))) ** 0.5
    angle = float(np.linalg.norm(rotation))
    return OdometryComparison(
        ScalarEstimate(float(theta[6]), float(np.sqrt(cov[6, 6])), n),
        ScalarEstimate(angle, angle / chi if angle else 1.0, n),
        nis,
        weight,
    )
