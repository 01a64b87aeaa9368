"""Whether two agents' odometries and depths are of one world, by the loops between them.

Every loop i between keyframes a of one stretch and b of another measures where the other odometry lies in
the one: Z = T_a T_a_b T_b^-1, as T_a, T_b are known since the starts of their stretches. If both tell the
truth all Z are one pose G, but for noise: of the loop, and of either odometry's random walk, which loops have
in common as far as both have walked. In left perturbations, xi = log(Z G^-1), that walk simply adds up:

    cov(xi_i, xi_j) = P_a(min) + Ad_G P_b(min) Ad_G' + [i = j] Ad_(G T_b) S_i Ad_(G T_b)',   P(k) = sum to k

What agents may be wrong about are further unknowns of these equations: a path that is longer by e^l than the
other's moves xi by -l times where the loop is, a camera that is turned on its body by phi turns it by
Ad_(G T_b) (phi, 0). Generalised least squares gives each with its sigma; loops are under a Cauchy kernel, for
some are false. The noise that is left for a loop, per degree of freedom, in the median, says whether the
covariances are too sure.
Source: Barfoot, *State Estimation for Robotics* (2017), chapters 5 and 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from share.geometry import se3
from share.mapping.recognition.depth_scale import DepthScale
from share.types import F64, I64

_ODOMETRY_SIGMA_SCALE = 2.0  # honest agents' sigmas of odometry are up to this much too small,
_LOOP_SIGMA_SCALE = 1.3  # those of loops this much
_CAUCHY_WIDTH_SQUARED = 12.0  # squared width of the kernel, of 6 dof
_IRLS_ITERATIONS = 6
_CHI2_6DOF_MEDIAN = 5.35  # of chi-square with 6 dof
_PRIOR_SIGMAS = np.array([0.2, 0.1, 0.1, 0.1])  # log scale, rad: only so that two loops have a solution
_MAD_PER_SIGMA = 0.6745  # median of |x| of a standard normal distribution
_MIN_INLIER_WEIGHT = 0.3  # weight of a loop below which it does not fit
_LOG_SCALE_FLOOR = 0.004  # of the log scale of one loop's points, beside what it says: occlusions, pixels
_AS_CLAIMED = (1.0, 1.0)
_MIN_SCALE_SIGMA = 0.003  # of honest agents' log scales: no two are calibrated better


@dataclass(frozen=True, eq=False)
class AccumulatedOdometry:
    """Where odometry has come: keyframe k of a stretch at T (4, 4) since its start, cov (6, 6) of its left
    perturbation."""

    index: int
    T: F64
    cov: F64

    @staticmethod
    def origin() -> AccumulatedOdometry:
        """At the first keyframe of a stretch."""
        return AccumulatedOdometry(0, np.eye(4), np.zeros((6, 6)))

    def with_step(self, T_ref_body: F64, cov: F64) -> AccumulatedOdometry:
        """One step further; cov (6, 6): of the step, right perturbation."""
        T = se3.orthonormal(self.T @ T_ref_body)
        Ad = se3.adjoint(T)
        return AccumulatedOdometry(self.index + 1, T, self.cov + Ad @ cov @ Ad.T)


@dataclass(frozen=True, eq=False)
class InterAgentLoop:
    """A loop as evidence: T_a_b (4, 4), cov (6, 6), between what either side has walked. scale: of b's depths
    over a's. tilt: (angle between both ups, its sigma), rad; None where gravity is not known."""

    a: AccumulatedOdometry
    b: AccumulatedOdometry
    T_a_b: F64
    cov: F64
    depth_scale: DepthScale | None = None
    tilt: tuple[float, float] | None = None


@dataclass(frozen=True)
class ScalarEstimate:
    """Of n loops."""

    value: float
    sigma: float
    count: int

    @property
    def significance(self) -> float:
        """In sigmas."""
        return abs(self.value) / self.sigma


@dataclass(frozen=True, eq=False)
class OdometryComparison:
    """Of b with a. points: log scale of b's depths; path: log of how much longer its way is. turn: of its
    camera on its body, rad. nis: of the loops' noise beyond all this, 1 if covariances are right.
    weight (N,): of each loop under the kernel."""

    path_scale: ScalarEstimate
    camera_rotation: ScalarEstimate
    nis: float
    weights: F64

    @property
    def inlier_share(self) -> float:
        """Share of the loops that fit."""
        return float((self.weights > _MIN_INLIER_WEIGHT).mean())


@dataclass(frozen=True, eq=False)
class ComparisonEquations:
    """Of N loops between two stretches: xi (N, 6); J (N, 6, 10), how it moves with G, the path's log scale
    and the camera's turn; and what adds up to its covariance, as claimed: either walk (N, 6, N, 6), each
    loop's own noise (N, 6, 6)."""

    xi: F64
    J: F64
    walk_cov_a: F64
    walk_cov_b: F64
    loop_cov: F64


def robust_depth_scale(scales: Sequence[DepthScale]) -> ScalarEstimate:
    """Robust mean of log scales, at least one. sigma: as they are spread, where that is more than said."""
    logs, variance = np.array([s.log for s in scales]), np.array([s.sigma for s in scales]) ** 2
    variance = variance + _LOG_SCALE_FLOOR**2
    mean, weight = float(np.median(logs)), np.ones(len(logs))
    mad_variance = float(np.median(np.abs(logs - mean)) / _MAD_PER_SIGMA) ** 2  # variance
    variance = variance * max(1.0, mad_variance / float(np.median(variance)))
    for _ in range(_IRLS_ITERATIONS):
        weight = 1 / (1 + (logs - mean) ** 2 / (4 * variance))
        mean = float((weight * logs / variance).sum() / (weight / variance).sum())
    information = weight / variance
    spread = float((information**2 * (logs - mean) ** 2).sum()) ** 0.5 / float(
        information.sum()
    )  # Huber's sandwich
    return ScalarEstimate(
        mean, float(np.hypot(max(information.sum() ** -0.5, spread), _MIN_SCALE_SIGMA)), len(logs)
    )


def compare_odometry(
    loops: Sequence[InterAgentLoop], widths: tuple[float, float] = _AS_CLAIMED
) -> OdometryComparison:
    """Of at least three loops between the same two stretches. widths: see `solve_comparison`."""
    return solve_comparison(comparison_equations(loops), widths)


def comparison_equations(loops: Sequence[InterAgentLoop]) -> ComparisonEquations:
    """Of loops between the same two stretches, about the middle of where they are."""
    T_a, T_b, T_a_b = (np.array(x) for x in zip(*((w.a.T, w.b.T, w.T_a_b) for w in loops), strict=True))
    T_centre = np.eye(4)
    T_centre[:3, 3] = -(T_a @ T_a_b)[:, :3, 3].mean(0)
    Ad = se3.adjoint(T_centre)
    T_a = T_centre @ T_a
    G = _consensus_pose(T_a @ T_a_b @ se3.inverse(T_b))
    walk_cov_a, walk_cov_b = (
        _shared_walk_cov([w.a for w in loops], Ad),
        _shared_walk_cov([w.b for w in loops], se3.adjoint(G)),
    )
    loop_cov = (
        se3.adjoint(T_a @ T_a_b) @ np.array([w.cov for w in loops]) @ se3.adjoint(T_a @ T_a_b).swapaxes(1, 2)
    )
    xi = se3.log(T_a @ T_a_b @ se3.inverse(T_b) @ se3.inverse(G))
    return ComparisonEquations(xi, _jacobian(T_a @ T_a_b), walk_cov_a, walk_cov_b, loop_cov)


def _consensus_pose(Z: F64) -> F64:
    """The one of N poses that most others agree with."""
    xi = se3.log((Z[:, None] @ se3.inverse(Z)[None]).reshape(-1, 4, 4)).reshape(len(Z), len(Z), 6)
    distance = np.minimum(1.0, np.linalg.norm(xi * (10, 10, 10, 1, 1, 1), axis=2))
    return np.asarray(Z[distance.sum(1).argmin()])


def _shared_walk_cov(accumulated: Sequence[AccumulatedOdometry], Ad: F64) -> F64:
    """What N loops have in common of one side's walk (N, 6, N, 6), since the first of them."""
    indices: I64 = np.array([w.index for w in accumulated])
    P = np.array([w.cov for w in accumulated])
    P = Ad @ (P - P[indices.argmin()]) @ Ad.T
    earlier = np.where(indices[:, None] <= indices, np.arange(len(indices))[:, None], np.arange(len(indices)))
    return np.asarray(P[earlier].transpose(0, 2, 1, 3))


def _jacobian(T_b: F64) -> F64:
    """How xi (N, 6) moves with G, the path's log scale and the camera's turn: (N, 6, 10)."""
    out = np.zeros((len(T_b), 6, 10))
    out[:, :, :6] = np.eye(6)
    out[:, 3:, 6] = -T_b[:, :3, 3]
    out[:, :, 7:] = se3.adjoint(T_b)[:, :, :3]
    return out


def solve_comparison(
    equations: ComparisonEquations, widths: tuple[float, float] = _AS_CLAIMED
) -> OdometryComparison:
    """What the agents are wrong about. widths: by what the variances of either walk are multiplied where the
    camera's turn is told, for the noise of an agent that is too sure passes for one at few places. Its way it
    is held to as it claims: one that is too long and too sure bends the others, and is found out sooner so.
    Raises LinAlgError where absurd numbers leave no solution."""
    weighted_residual = _solved(equations, _AS_CLAIMED)
    return (
        weighted_residual
        if widths == _AS_CLAIMED
        else replace(weighted_residual, camera_rotation=_solved(equations, widths).camera_rotation)
    )


def _solved(e: ComparisonEquations, widths: tuple[float, float]) -> OdometryComparison:
    xi, J, n = e.xi, e.J, len(e.xi)
    walk, own = (
        _ODOMETRY_SIGMA_SCALE**2 * (widths[0] * e.walk_cov_a + widths[1] * e.walk_cov_b),
        _LOOP_SIGMA_SCALE**2 * e.loop_cov,
    )
    rows, prior = J.reshape(6 * n, 10), np.zeros((10, 10))
    prior[range(6, 10), range(6, 10)] = _PRIOR_SIGMAS**-2
    information, weight = np.linalg.inv(own), np.ones(n)
    for _ in range(_IRLS_ITERATIONS):
        C = walk.copy()
        C[range(n), :, range(n)] += own / weight[:, None, None]
        inverse = np.linalg.inv(C.reshape(6 * n, 6 * n))
        normal = rows.T @ inverse @ rows + prior
        theta = np.linalg.solve(normal, rows.T @ inverse @ xi.ravel())
        left = xi.ravel() - rows @ theta
        told = (inverse @ left).reshape(n, 6)
        noise = (own @ told[:, :, None])[:, :, 0] / weight[:, None]
        chi2 = np.einsum("ni,nij,nj->n", noise, information, noise)
        weight = 1 / (1 + chi2 / _CAUCHY_WIDTH_SQUARED)
    nis = float(np.median(chi2)) / _CHI2_6DOF_MEDIAN
    misfit = float(left @ inverse @ left) / max(1, 6 * n - 10)  # of loops and ways: a wrong model shows here
    cov = np.linalg.inv(normal) * max(1.0, nis, misfit)
    turn = theta[7:]
    chi = max(1e-6, float(turn @ np.linalg.solve(cov[7:, 7:], turn))) ** 0.5
    size = float(np.linalg.norm(turn))
    return OdometryComparison(
        ScalarEstimate(float(theta[6]), float(np.sqrt(cov[6, 6])), n),
        ScalarEstimate(size, size / chi if size else 1.0, n),
        nis,
        weight,
    )
