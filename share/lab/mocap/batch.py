"""Least squares over all nodes at once, by Levenberg and Marquardt with a robust mocap."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from share.errors import MisfitError
from share.geometry import se3
from share.geometry.camera import ImuNoise
from share.lab.mocap.factors import Chain, Sightings, imu_chain, sightings
from share.lab.mocap.mocap import Mocap
from share.lab.mocap.state import NODE, SHARED, FitOptions, State
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


# ---- Normal equations of a chain of nodes that also shares a few unknowns: a band with a border.
#
# The band is factored once (Cholesky), the border is eliminated by its Schur complement: linear in the number
# of nodes. Source: Golub and Van Loan, *Matrix Computations*, 4th ed., 4.3.5 and 3.2.


@dataclass(frozen=True, eq=False)
class Normal:
    """H dx = -b. diagonal (N, 15, 15), below (N - 1, 15, 15): rows of the later node; border (N, 15, 10);
    corner (10, 10); b_nodes (N, 15), b_shared (10,)."""

    diagonal: F64
    below: F64
    border: F64
    corner: F64
    b_nodes: F64
    b_shared: F64


def normal_equations(
    chain: Chain, seen: Sightings, weight: F64, prior: F64, off_prior: F64, n: int
) -> Normal:
    """Of all residuals; weight (K,) for the mocap's; prior (10,): information of the shared unknowns'
    first guess, off_prior (10,): how far they have moved from it."""
    J0, J1, r = chain.by_before, chain.by_after, chain.residual[..., None]
    diagonal, b = np.zeros((n, NODE, NODE)), np.zeros((n, NODE))
    diagonal[:-1] += J0.swapaxes(1, 2) @ J0
    diagonal[1:] += J1.swapaxes(1, 2) @ J1
    b[:-1] += (J0.swapaxes(1, 2) @ r)[..., 0]
    b[1:] += (J1.swapaxes(1, 2) @ r)[..., 0]

    J = np.concatenate([seen.by_node, seen.by_shared, seen.residual[..., None]], axis=2)
    J = J * np.sqrt(weight)[:, None, None]
    nodes, first = np.unique(seen.node, return_index=True)  # samples come in the order of nodes
    products = np.add.reduceat(J.swapaxes(1, 2) @ J, first, axis=0)
    shared = products[:, NODE:-1, NODE:].sum(0)
    diagonal[nodes] += products[:, :NODE, :NODE]
    b[nodes] += products[:, :NODE, -1]
    border = np.zeros((n, NODE, SHARED))
    border[nodes] = products[:, :NODE, NODE:-1]
    corner = shared[:, :-1] + np.diag(prior)
    return Normal(diagonal, J1.swapaxes(1, 2) @ J0, border, corner, b, shared[:, -1] + prior * off_prior)


def solve(normal: Normal, damping: float) -> tuple[F64, F64, F64]:
    """Steps (N, 15) and (10,), and the covariance (10, 10) of the shared unknowns, with every diagonal
    element raised by the factor 1 + damping (Marquardt 1963). Raises LinAlgError if not positive."""
    from scipy.linalg import cho_solve_banded, cholesky_banded

    n = len(normal.diagonal)
    band = _banded(normal, damping)
    factor = (cholesky_banded(band, lower=True), True)
    right = np.concatenate([normal.border, normal.b_nodes[..., None]], axis=2).reshape(n * NODE, SHARED + 1)
    solved = cho_solve_banded(factor, right)
    border = right[:, :-1]
    corner = normal.corner + np.diag(np.diag(normal.corner) * damping)
    cov = np.linalg.inv(corner - border.T @ solved[:, :-1])
    shared = -cov @ (normal.b_shared - border.T @ solved[:, -1])
    nodes = -(solved[:, -1] + solved[:, :-1] @ shared)
    return nodes.reshape(n, NODE), shared, (cov + cov.T) / 2


def _banded(normal: Normal, damping: float) -> F64:
    """Lower band of the nodes' part: element (r, c) at [r - c, c]."""
    n = len(normal.diagonal)
    out = np.zeros((2 * NODE, n, NODE))
    for c in range(NODE):
        out[: NODE - c, :, c] = normal.diagonal[:, c:, c].T
        out[NODE - c : 2 * NODE - c, :-1, c] = normal.below[:, :, c].T
    out[0] *= 1 + damping
    return out.reshape(2 * NODE, n * NODE)


def node_covariances(normal: Normal, cov_shared: F64) -> F64:
    """Marginal covariances (N, 15, 15) of the nodes: the band's own by a forward and a backward
    elimination, plus what the shared unknowns' uncertainty adds."""
    from scipy.linalg import cho_solve_banded, cholesky_banded

    n = len(normal.diagonal)
    forward, backward = normal.diagonal.copy(), normal.diagonal.copy()
    for i in range(1, n):
        L = normal.below[i - 1]
        forward[i] -= L @ np.linalg.solve(forward[i - 1], L.T)
        L = normal.below[n - 1 - i]
        backward[n - 1 - i] -= L.T @ np.linalg.solve(backward[n - i], L)
    own = np.linalg.inv(forward + backward - normal.diagonal)
    factor = (cholesky_banded(_banded(normal, 0.0), lower=True), True)
    spread = cho_solve_banded(factor, normal.border.reshape(n * NODE, SHARED)).reshape(n, NODE, SHARED)
    return np.asarray(own + spread @ cov_shared @ spread.swapaxes(1, 2), np.float64)
