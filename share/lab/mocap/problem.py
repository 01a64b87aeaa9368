"""Least squares over all nodes by Levenberg-Marquardt, with robust weights of the mocap."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from share.errors import CalibrationMismatchError
from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.lab.mocap.factors import ImuChain, MocapObservations, imu_chain, mocap_observations
from share.lab.mocap.state import NODE_SIZE, SHARED_SIZE, MocapFitOptions, MocapImuState
from share.lab.mocap.trajectory import MocapTrajectory
from share.types import F64, ImuBatch

_BIAS_SIGMA = np.repeat([0.2, 1.0], 3)  # rad/s, m/s^2: larger than any IMU's; holds unobservable biases only
_TILT_SIGMA = 1.0  # rad: practically no prior
CHECK = (
    "check units (m, rad/s, m/s^2), the order of quaternions (TUM: qx qy qz qw; .csv: qw qx qy qz), and that "
    "both are of one body"
)
MIN_INLIER_WEIGHT = 0.2
_CONVERGED = 1e-6  # relative decrease of the cost, far below the effect of one sigma


@dataclass(frozen=True, eq=False)
class BatchSolution:
    """The solution: state, residuals, weights (K,) of the mocap samples, 0..1, and normal equations there."""

    state: MocapImuState
    chain: ImuChain
    observations: MocapObservations
    weight: F64
    normal: BorderedNormals
    cov_shared: F64

    @property
    def is_inlier(self) -> np.ndarray:
        """(K,) bool: inlier samples."""
        return np.asarray(self.weight > MIN_INLIER_WEIGHT, bool)


@dataclass(frozen=True, eq=False)
class MocapImuProblem:
    """The IMU with its (inflated) noise, the mocap in the IMU's clock, the chain's breaks, and a first
    T_body_mocap (4, 4)."""

    imu: ImuBatch
    noise: ImuNoise
    mocap: MocapTrajectory
    is_break: np.ndarray
    initial_T_body_mocap: F64
    options: MocapFitOptions

    def solve_robustly(self, state: MocapImuState) -> BatchSolution:
        """Minimise, then again with the inliers only: a single outlier pulls little, but seconds of them
        all pull in one direction. The weights returned are of all samples."""
        solved = self.minimise(state)
        inliers = solved.is_inlier
        if inliers.all() or inliers.mean() < 0.5:
            return solved
        inlier_problem = replace(
            self, mocap=MocapTrajectory(self.mocap.stamps_ns[inliers], self.mocap.T[inliers])
        )
        solved = inlier_problem.minimise(solved.state)
        observations = self._observations(solved.state)
        return replace(solved, observations=observations, weight=self._weight(observations))

    def minimise(self, state: MocapImuState) -> BatchSolution:
        """Minimise the cost from `state`. Raises CalibrationMismatchError if it does not converge."""
        chain, observations, cost = self._evaluate(state)
        damping = 1e-4
        for _ in range(self.options.max_iterations):
            normal = self._normal(state, chain, observations)
            nodes, shared, _ = solve_bordered(normal, damping)
            trial = state.updated(nodes, shared)
            trial_result = self._evaluate(trial)
            if not trial_result[2] < cost:
                if damping > 1e6 or trial_result[2] - cost < _CONVERGED * cost:
                    break
                damping *= 10
                continue
            has_converged = cost - trial_result[2] < _CONVERGED * cost
            state, (chain, observations, cost) = trial, trial_result
            damping = max(damping / 10, 1e-12)
            if has_converged:
                break
        else:
            raise CalibrationMismatchError(
                f"mocap and IMU: no solution after {self.options.max_iterations} steps; {CHECK}"
            )
        normal = self._normal(state, chain, observations)
        weight = self._weight(observations)
        return BatchSolution(state, chain, observations, weight, normal, solve_bordered(normal, 0.0)[2])

    @property
    def sample_weight(self) -> float:
        """Weight of one mocap sample: samples denser than independent ones share a weight of 1."""
        return min(1.0, self.options.independent_hz * self.mocap.spacing_ns * 1e-9)

    def _sigma(self) -> F64:
        return np.repeat([self.options.sigma_rotation, self.options.sigma_position], 3)

    def _weight(self, observations: MocapObservations) -> F64:
        """Return Cauchy weights (K,) by the mean square of the six residuals."""
        return np.asarray(
            1 / (1 + (observations.residual**2).mean(1) / self.options.cauchy_sigmas**2), np.float64
        )

    def _evaluate(self, state: MocapImuState) -> tuple[ImuChain, MocapObservations, float]:
        chain = imu_chain(state, self.imu, self.noise, self.options.gravity, self.is_break)
        observations = self._observations(state)
        robust_cost = (
            -6 * self.options.cauchy_sigmas**2 * np.log(self._weight(observations)).sum() * self.sample_weight
        )
        bias_prior = np.concatenate([state.gyro_bias[0], state.accel_bias[0]]) / _BIAS_SIGMA
        prior = (self._prior_information() * self._prior_deviation(state) ** 2).sum()
        return (
            chain,
            observations,
            float((chain.residual**2).sum() + robust_cost + (bias_prior**2).sum() + prior),
        )

    def _observations(self, state: MocapImuState) -> MocapObservations:
        t, T = self.mocap.stamps_ns, self.mocap.T
        return mocap_observations(state, self.imu, self.options.gravity, t, T, self._sigma())

    def _normal(
        self, state: MocapImuState, chain: ImuChain, observations: MocapObservations
    ) -> BorderedNormals:
        weight = self._weight(observations) * self.sample_weight
        out = normal_equations(
            chain, observations, weight, self._prior_information(), self._prior_deviation(state), len(state.p)
        )
        out.diagonal[0, 9:, 9:] += np.diag(_BIAS_SIGMA**-2)
        out.b_nodes[0, 9:] += np.concatenate([state.gyro_bias[0], state.accel_bias[0]]) / _BIAS_SIGMA**2
        return out

    def _prior_information(self) -> F64:
        """Return the information (10,) of the first guess, nearly zero without a guess by the user."""
        rotation, position = (3.0, 3.0) if self.options.T_body_mocap is None else self.options.guess_sigma
        sigma = (
            [_TILT_SIGMA] * 2
            + [rotation] * 3
            + [position] * 3
            + [self.options.offset_sigma, self.options.drift_sigma]
        )
        return np.array(sigma) ** -2

    def _prior_deviation(self, state: MocapImuState) -> F64:
        """Return the deviation (10,) of the shared unknowns from the first guess."""
        out = np.zeros(SHARED_SIZE)
        out[:2], out[8], out[9] = state.tilt, state.offset_s, state.drift
        out[2:8] = se3.log(se3.inverse(self.initial_T_body_mocap) @ state.T_body_mocap)
        return out


# Normal equations of a chain of nodes with a few shared unknowns: a band with a border.
#
# The band is factored once (Cholesky), the border is eliminated by its Schur complement: linear in the number
# of nodes. Source: Golub and Van Loan, *Matrix Computations*, 4th ed., 4.3.5 and 3.2.


@dataclass(frozen=True, eq=False)
class BorderedNormals:
    """H dx = -b. diagonal (N, 15, 15), below (N - 1, 15, 15): rows of the later node; border (N, 15, 10);
    corner (10, 10); b_nodes (N, 15), b_shared (10,)."""

    diagonal: F64
    below: F64
    border: F64
    corner: F64
    b_nodes: F64
    b_shared: F64


def normal_equations(
    chain: ImuChain, observations: MocapObservations, weight: F64, prior: F64, prior_deviation: F64, n: int
) -> BorderedNormals:
    """Return the normal equations of all residuals. weight (K,): of the mocap's. prior (10,): information
    of the first guess of the shared unknowns; prior_deviation (10,): deviation from it."""
    J0, J1, r = chain.jacobian_before, chain.jacobian_after, chain.residual[..., None]
    diagonal, b = np.zeros((n, NODE_SIZE, NODE_SIZE)), np.zeros((n, NODE_SIZE))
    diagonal[:-1] += J0.swapaxes(1, 2) @ J0
    diagonal[1:] += J1.swapaxes(1, 2) @ J1
    b[:-1] += (J0.swapaxes(1, 2) @ r)[..., 0]
    b[1:] += (J1.swapaxes(1, 2) @ r)[..., 0]

    J = np.concatenate(
        [observations.jacobian_node, observations.jacobian_shared, observations.residual[..., None]], axis=2
    )
    J = J * np.sqrt(weight)[:, None, None]
    nodes, first = np.unique(observations.node, return_index=True)  # samples are in the order of nodes
    products = np.add.reduceat(J.swapaxes(1, 2) @ J, first, axis=0)
    shared = products[:, NODE_SIZE:-1, NODE_SIZE:].sum(0)
    diagonal[nodes] += products[:, :NODE_SIZE, :NODE_SIZE]
    b[nodes] += products[:, :NODE_SIZE, -1]
    border = np.zeros((n, NODE_SIZE, SHARED_SIZE))
    border[nodes] = products[:, :NODE_SIZE, NODE_SIZE:-1]
    corner = shared[:, :-1] + np.diag(prior)
    return BorderedNormals(
        diagonal, J1.swapaxes(1, 2) @ J0, border, corner, b, shared[:, -1] + prior * prior_deviation
    )


def solve_bordered(normal: BorderedNormals, damping: float) -> tuple[F64, F64, F64]:
    """Return steps (N, 15) and (10,), and the covariance (10, 10) of the shared unknowns, with diagonals
    raised by the factor 1 + damping (Marquardt 1963). Raises LinAlgError if not positive definite."""
    from scipy.linalg import cho_solve_banded, cholesky_banded

    n = len(normal.diagonal)
    band = _banded(normal, damping)
    factor = (cholesky_banded(band, lower=True), True)
    right_hand_sides = np.concatenate([normal.border, normal.b_nodes[..., None]], axis=2).reshape(
        n * NODE_SIZE, SHARED_SIZE + 1
    )
    solved = cho_solve_banded(factor, right_hand_sides)
    border = right_hand_sides[:, :-1]
    corner = normal.corner + np.diag(np.diag(normal.corner) * damping)
    cov = np.linalg.inv(corner - border.T @ solved[:, :-1])
    shared = -cov @ (normal.b_shared - border.T @ solved[:, -1])
    nodes = -(solved[:, -1] + solved[:, :-1] @ shared)
    return nodes.reshape(n, NODE_SIZE), shared, (cov + cov.T) / 2


def _banded(normal: BorderedNormals, damping: float) -> F64:
    """Return the lower band of the nodes' part: element (r, c) at [r - c, c]."""
    n = len(normal.diagonal)
    out = np.zeros((2 * NODE_SIZE, n, NODE_SIZE))
    for c in range(NODE_SIZE):
        out[: NODE_SIZE - c, :, c] = normal.diagonal[:, c:, c].T
        out[NODE_SIZE - c : 2 * NODE_SIZE - c, :-1, c] = normal.below[:, :, c].T
    out[0] *= 1 + damping
    return out.reshape(2 * NODE_SIZE, n * NODE_SIZE)


def node_covariances(normal: BorderedNormals, cov_shared: F64) -> F64:
    """Return marginal covariances (N, 15, 15) of the nodes: the band's by forward and backward
    elimination, plus the effect of the shared unknowns' uncertainty."""
    from scipy.linalg import cho_solve_banded, cholesky_banded

    n = len(normal.diagonal)
    forward, backward = normal.diagonal.copy(), normal.diagonal.copy()
    for i in range(1, n):
        L = normal.below[i - 1]
        forward[i] -= L @ np.linalg.solve(forward[i - 1], L.T)
        L = normal.below[n - 1 - i]
        backward[n - 1 - i] -= L.T @ np.linalg.solve(backward[n - i], L)
    band_covariance = np.linalg.inv(forward + backward - normal.diagonal)
    factor = (cholesky_banded(_banded(normal, 0.0), lower=True), True)
    shared_influence = cho_solve_banded(factor, normal.border.reshape(n * NODE_SIZE, SHARED_SIZE)).reshape(
        n, NODE_SIZE, SHARED_SIZE
    )
    return np.asarray(
        band_covariance + shared_influence @ cov_shared @ shared_influence.swapaxes(1, 2), np.float64
    )
