"""Least squares over all nodes at once, by Levenberg and Marquardt with a robust mocap."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from share.errors import MisfitError
from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.mocap.factors import Chain, Sightings, imu_chain, sightings
from share.mocap.mocap import Mocap
from share.mocap.options import FitOptions
from share.mocap.solve import Normal, normal_equations, solve
from share.mocap.state import SHARED, State
from share.types import F64, ImuBatch

_BIAS_SIGMA = np.repeat([0.2, 1.0], 3)  # rad/s, m/s^2: no IMU is worse; only holds what no motion shows
_TILT_SIGMA = 1.0  # rad: none to speak of
CHECK = (
    "check units (m, rad/s, m/s^2), the order of quaternions (TUM: qx qy qz qw; .csv: qw qx qy qz), and that "
    "both are of one body"
)
TRUSTED = 0.2  # weight of a sample that counts as seen
_CONVERGED = 1e-6  # of the cost: far below what one sigma of anything costs


@dataclass(frozen=True, eq=False)
class Solved:
    """The best state, what it was judged by, and its weights (K,) of the mocap samples, 0..1."""

    state: State
    chain: Chain
    seen: Sightings
    weight: F64
    normal: Normal
    cov_shared: F64

    @property
    def trusted(self) -> np.ndarray:
        """(K,) bool: samples that count as seen."""
        return np.asarray(self.weight > TRUSTED, bool)


@dataclass(frozen=True, eq=False)
class Batch:
    """One problem: the IMU with its (inflated) noise, the mocap in the IMU's clock, where the chain of
    nodes is broken, and a first T_body_mocap (4, 4)."""

    imu: ImuBatch
    noise: ImuNoise
    mocap: Mocap
    breaks: np.ndarray
    guess: F64
    options: FitOptions

    def settle(self, state: State) -> Solved:
        """`minimise`, then again by the trusted samples alone: of those that are elsewhere each pulls but a
        little, but seconds of them all pull one way. Weights are of all samples."""
        solved = self.minimise(state)
        trusted = solved.trusted
        if trusted.all() or trusted.mean() < 0.5:
            return solved
        few = replace(self, mocap=Mocap(self.mocap.stamps_ns[trusted], self.mocap.T[trusted]))
        solved = few.minimise(solved.state)
        seen = self._seen(solved.state)
        return replace(solved, seen=seen, weight=self._weight(seen))

    def minimise(self, state: State) -> Solved:
        """From `state` downhill until the cost stands still. Raises MisfitError if it never does."""
        chain, seen, cost = self._measure(state)
        damping = 1e-4
        for _ in range(self.options.max_iterations):
            normal = self._normal(state, chain, seen)
            nodes, shared, _ = solve(normal, damping)
            moved = state.moved(nodes, shared)
            tried = self._measure(moved)
            if not tried[2] < cost:
                if damping > 1e6 or tried[2] - cost < _CONVERGED * cost:
                    break
                damping *= 10
                continue
            done = cost - tried[2] < _CONVERGED * cost
            state, (chain, seen, cost) = moved, tried
            damping = max(damping / 10, 1e-12)
            if done:
                break
        else:
            raise MisfitError(
                f"mocap and IMU: no solution after {self.options.max_iterations} steps; {CHECK}"
            )
        normal = self._normal(state, chain, seen)
        weight = self._weight(seen)
        return Solved(state, chain, seen, weight, normal, solve(normal, 0.0)[2])

    @property
    def share(self) -> float:
        """What one mocap sample counts for: samples denser than they err independently share."""
        return min(1.0, self.options.independent_hz * self.mocap.spacing_ns * 1e-9)

    def _sigma(self) -> F64:
        return np.repeat([self.options.sigma_rotation, self.options.sigma_position], 3)

    def _weight(self, seen: Sightings) -> F64:
        """Cauchy's, of the mean square of the six: (K,)."""
        return np.asarray(1 / (1 + (seen.residual**2).mean(1) / self.options.cauchy**2), np.float64)

    def _measure(self, state: State) -> tuple[Chain, Sightings, float]:
        chain = imu_chain(state, self.imu, self.noise, self.options.gravity, self.breaks)
        seen = self._seen(state)
        robust = -6 * self.options.cauchy**2 * np.log(self._weight(seen)).sum() * self.share
        first = np.concatenate([state.gyro_bias[0], state.accel_bias[0]]) / _BIAS_SIGMA
        prior = (self._prior() * self._strayed(state) ** 2).sum()
        return chain, seen, float((chain.residual**2).sum() + robust + (first**2).sum() + prior)

    def _seen(self, state: State) -> Sightings:
        t, T = self.mocap.stamps_ns, self.mocap.T
        return sightings(state, self.imu, self.options.gravity, t, T, self._sigma())

    def _normal(self, state: State, chain: Chain, seen: Sightings) -> Normal:
        weight = self._weight(seen) * self.share
        out = normal_equations(chain, seen, weight, self._prior(), self._strayed(state), len(state.p))
        out.diagonal[0, 9:, 9:] += np.diag(_BIAS_SIGMA**-2)
        out.b_nodes[0, 9:] += np.concatenate([state.gyro_bias[0], state.accel_bias[0]]) / _BIAS_SIGMA**2
        return out

    def _prior(self) -> F64:
        """Information (10,) of the first guess; without one from the user, hardly any."""
        rotation, position = (3.0, 3.0) if self.options.T_body_mocap is None else self.options.guess_sigma
        sigma = (
            [_TILT_SIGMA] * 2
            + [rotation] * 3
            + [position] * 3
            + [self.options.offset_sigma, self.options.drift_sigma]
        )
        return np.array(sigma) ** -2

    def _strayed(self, state: State) -> F64:
        """How far (10,) the shared unknowns are from the first guess."""
        out = np.zeros(SHARED)
        out[:2], out[8], out[9] = state.tilt, state.offset_s, state.drift
        out[2:8] = se3.log(se3.inverse(self.guess) @ state.T_body_mocap)
        return out
