"""Least squares over all nodes, with robust weights of the mocap; the scale of the mocap's axes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from share.errors import CalibrationMismatchError
from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.lab.calibrate.camera_imu.problem import BIAS_SIGMA
from share.lab.calibrate.handeye import CAUCHY_SIGMAS
from share.lab.least_squares import ArrowFactor, ArrowSystem, minimise
from share.lab.mocap.factors import ImuChain, MocapObservations, imu_chain, mocap_observations
from share.lab.mocap.state import NODE_SIZE, SHARED_SIZE, MocapFitOptions, MocapImuState
from share.lab.mocap.trajectory import MocapTrajectory
from share.types import F64, ImuBatch

_TILT_SIGMA = 1.0  # rad: practically no prior
CHECK = (
    "check units (m, rad/s, m/s^2), the order of quaternions (TUM: qx qy qz qw; .csv: qw qx qy qz), and that "
    "both are of one body"
)
_MIN_INLIER_WEIGHT = 0.2
_MAX_STEPS = 50
_CONVERGED = 1e-6  # relative decrease of the cost, far below the effect of one sigma

_Residuals: TypeAlias = tuple[ImuChain, MocapObservations]


@dataclass(frozen=True, eq=False)
class BatchSolution:
    """The solution: state, residuals, weights (K,) of the mocap samples, 0..1, and normal equations there."""

    state: MocapImuState
    chain: ImuChain
    observations: MocapObservations
    weight: F64
    system: ArrowSystem

    @property
    def is_inlier(self) -> np.ndarray:
        """(K,) bool: inlier samples."""
        return np.asarray(self.weight > _MIN_INLIER_WEIGHT, bool)


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

        def step(at: MocapImuState, residuals: _Residuals, damping: float) -> MocapImuState:
            return at.updated(*self._system(at, *residuals).solve(damping))

        minimum = minimise(state, self._evaluate, step, _MAX_STEPS, _CONVERGED)
        if not minimum.converged:
            raise CalibrationMismatchError(f"mocap and IMU: no solution after {_MAX_STEPS} steps; {CHECK}")
        chain, observations = minimum.linearised
        weight = self._weight(observations)
        return BatchSolution(
            minimum.state,
            chain,
            observations,
            weight,
            self._system(minimum.state, chain, observations),
        )

    @property
    def sample_weight(self) -> float:
        """Weight of one mocap sample: samples denser than independent ones share a weight of 1."""
        return min(1.0, self.options.independent_hz * self.mocap.spacing_ns * 1e-9)

    def _weight(self, observations: MocapObservations) -> F64:
        """Return Cauchy weights (K,) by the mean square of the six residuals."""
        return np.asarray(1 / (1 + (observations.residual**2).mean(1) / CAUCHY_SIGMAS**2), np.float64)

    def _evaluate(self, state: MocapImuState) -> tuple[_Residuals, float]:
        chain = imu_chain(state, self.imu, self.noise, self.options.gravity, self.is_break)
        observations = self._observations(state)
        robust_cost = -6 * CAUCHY_SIGMAS**2 * np.log(self._weight(observations)).sum() * self.sample_weight
        bias_prior = np.concatenate([state.gyro_bias[0], state.accel_bias[0]]) / BIAS_SIGMA
        prior = (self._prior_information() * self._prior_deviation(state) ** 2).sum()
        cost = float((chain.residual**2).sum() + robust_cost + (bias_prior**2).sum() + prior)
        return (chain, observations), cost

    def _observations(self, state: MocapImuState) -> MocapObservations:
        sigma = np.repeat([self.options.sigma_rotation, self.options.sigma_position], 3)
        return mocap_observations(
            state, self.imu, self.options.gravity, self.mocap.stamps_ns, self.mocap.T, sigma
        )

    def _system(self, state: MocapImuState, chain: ImuChain, observations: MocapObservations) -> ArrowSystem:
        weight = self._weight(observations) * self.sample_weight
        out = normal_equations(
            chain, observations, weight, self._prior_information(), self._prior_deviation(state), len(state.p)
        )
        out.blocks[0, 0, 9:, 9:] += np.diag(BIAS_SIGMA**-2)
        out.g_nodes[0, 9:] -= np.concatenate([state.gyro_bias[0], state.accel_bias[0]]) / BIAS_SIGMA**2
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


def normal_equations(
    chain: ImuChain, observations: MocapObservations, weight: F64, prior: F64, prior_deviation: F64, n: int
) -> ArrowSystem:
    """Return the normal equations of all residuals for n nodes (15) and the shared unknowns (10).

    weight (K,): of the mocap's. prior (10,): information of the first guess of the shared unknowns;
    prior_deviation (10,): deviation from it.
    """
    J0, J1, r = chain.jacobian_before, chain.jacobian_after, chain.residual[..., None]
    blocks, g = np.zeros((n, 2, NODE_SIZE, NODE_SIZE)), np.zeros((n, NODE_SIZE))
    blocks[:-1, 0] += J0.swapaxes(1, 2) @ J0
    blocks[1:, 0] += J1.swapaxes(1, 2) @ J1
    blocks[:-1, 1] = J0.swapaxes(1, 2) @ J1
    g[:-1] -= (J0.swapaxes(1, 2) @ r)[..., 0]
    g[1:] -= (J1.swapaxes(1, 2) @ r)[..., 0]

    J = np.concatenate(
        [observations.jacobian_node, observations.jacobian_shared, observations.residual[..., None]], axis=2
    )
    J = J * np.sqrt(weight)[:, None, None]
    nodes, first = np.unique(observations.node, return_index=True)  # samples are in the order of nodes
    products = np.add.reduceat(J.swapaxes(1, 2) @ J, first, axis=0)
    shared = products[:, NODE_SIZE:-1, NODE_SIZE:].sum(0)
    blocks[nodes, 0] += products[:, :NODE_SIZE, :NODE_SIZE]
    g[nodes] -= products[:, :NODE_SIZE, -1]
    edge = np.zeros((n, NODE_SIZE, SHARED_SIZE))
    edge[nodes] = products[:, :NODE_SIZE, NODE_SIZE:-1]
    return ArrowSystem(
        blocks, edge, shared[:, :-1] + np.diag(prior), g, -shared[:, -1] - prior * prior_deviation
    )


def axis_scales(
    solved: BatchSolution, mocap: MocapTrajectory, sigma: float, sample_weight: float
) -> tuple[F64, F64]:
    """Compare the mocap's axes with the accelerometer: return by how much positions along the axes of the
    mocap's world are too long, (3,), 0.01: 1 %, and the covariance (3, 3).

    sigma m: noise of a position. sample_weight: of one sample. One unknown per axis that the fit did not
    have: a Gauss-Newton step from its solution with all other unknowns free (the Schur complement of the
    three). A mirrored axis shows as a scale far from 1 even where the path moves so little along it that the
    fit converges.
    """
    # positions as fitted, since noise would bias the scale
    p = mocap.T[:, :3, 3] + solved.observations.residual[:, 3:] * sigma
    p = p - p.mean(0)
    J = np.zeros((len(p), 6, 3))
    J[:, 3:] = -p[:, None] * np.eye(3) / sigma
    weight = solved.weight * solved.is_inlier * sample_weight
    JW = (J * weight[:, None, None]).swapaxes(1, 2)
    nodes = np.zeros_like(solved.system.edge[..., :3])
    np.add.at(nodes, solved.observations.node, (JW @ solved.observations.jacobian_node).swapaxes(1, 2))
    shared = (JW @ solved.observations.jacobian_shared).sum(0).T
    by_nodes, by_shared = ArrowFactor(solved.system).solve(nodes, shared)
    information = (JW @ J).sum(0) - np.einsum("nij,nik->jk", nodes, by_nodes) - shared.T @ by_shared
    gradient = (JW @ solved.observations.residual[..., None]).sum(0)[:, 0]
    gradient += np.einsum("nij,ni->j", by_nodes, solved.system.g_nodes) + solved.system.g_border @ by_shared
    cov = np.linalg.inv((information + information.T) / 2)
    return np.asarray(cov @ gradient, np.float64), cov
