"""One Gauss-Newton step of a pose graph, by conjugate gradients.

The agents' own odometry makes long chains; the equations along them are block tridiagonal and solved
in a millisecond. They, with every other edge's information added at both its ends, precondition
the whole; what the loops couple is left to the iterations: some 40, however many loops there are. A
factorisation of the whole fills in instead. Source: Dellaert et al., *Subgraph-preconditioned
Conjugate Gradients for Large Scale SLAM*, IROS 2010.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from share.config import GraphConfig
from share.geometry import se3
from share.mapping.graph.edges import EdgeArrays, EdgeResiduals, jacobians, residuals, tilt_projector
from share.mapping.graph.edges import gravity_cost as plumb_cost
from share.mapping.graph.edges import gravity_equations as plumb_equations
from share.types import F64, I64

# ---- Levenberg-Marquardt on re-weighted least squares: the most likely poses of one connected part.
#
# Odometry is Gaussian; loops are under a Cauchy kernel, since one false loop must not bend the map. Source:
# Triggs et al., *Bundle Adjustment: A Modern Synthesis*, 2000; Cauchy against 30 % false loops:
# docs/understand/mapping.md.

_INITIAL_DAMPING, _MAX_DAMPING = 1e-4, 1e8
_MIN_CURVATURE = 0.5  # of a loop along its residual, beside that across; 0.3 overshot at times


@dataclass(frozen=True, eq=False)
class OptimisedPoses:
    """poses (N, 4, 4). free (6, 6): what the held pose may do, a projector. at: the residuals there. weights
    (E,): what the kernel leaves of each edge's information. reason: why there is no minimum and the poses
    are as they were, or empty."""

    poses: F64
    gauge_projector: F64
    residuals: EdgeResiduals
    weights: F64
    iterations: int
    reason: str = ""


def optimise(
    poses: F64, gravity_factors: F64, edges: EdgeArrays, anchor_index: int, config: GraphConfig
) -> OptimisedPoses:
    """From poses (N, 4, 4), in `chain_order`, with `share.mapping.graph.edges` (N, 3) each. Pose `held`
    stays, to the bit where no plumb line is known; where one is, it tilts about its place. Deterministic."""
    with np.errstate(all="ignore"):
        return _levenberg_marquardt(poses, gravity_factors, edges, anchor_index, config)


def _levenberg_marquardt(
    poses: F64, gravity_factors: F64, edges: EdgeArrays, anchor_index: int, config: GraphConfig
) -> OptimisedPoses:
    current, damping, iterations = residuals(poses, edges), 0.0, 0
    gauge_projector = tilt_projector(poses[anchor_index]) if gravity_factors.any() else np.zeros((6, 6))

    def cost_of(at: EdgeResiduals, poses: F64) -> float:
        return _robust_cost(at, edges, config) + plumb_cost(poses, gravity_factors)

    cost = cost_of(current, poses)
    if not np.isfinite(cost):
        reason = "the error is not finite to begin with"
        return OptimisedPoses(
            poses, gauge_projector, current, _cauchy_weights(current, edges, config), 0, reason
        )
    equations = NormalEquations(len(poses), edges, anchor_index, gauge_projector)
    while (
        (len(edges) or gauge_projector.any())
        and iterations < config.max_iterations
        and damping <= _MAX_DAMPING
    ):
        iterations += 1
        step = _gauss_newton_step(
            equations, current, edges, plumb_equations(poses, gravity_factors), damping, config
        )
        trial_poses = poses @ se3.exp(step)
        trial = residuals(trial_poses, edges)
        trial_cost = cost_of(trial, trial_poses)
        if not trial_cost <= cost:  # nor if it is not finite
            damping = max(10 * damping, _INITIAL_DAMPING)
            continue
        gain, cost, poses, current = cost - trial_cost, trial_cost, trial_poses, trial
        damping = damping / 10 if damping > _INITIAL_DAMPING else 0.0
        if np.abs(step).max() < config.step_tolerance or gain <= config.relative_tolerance * cost:
            break
    return OptimisedPoses(
        poses, gauge_projector, current, _cauchy_weights(current, edges, config), iterations
    )


def weighted_jacobians(residuals_at: EdgeResiduals, weights: F64, edges: EdgeArrays) -> tuple[F64, F64]:
    """By a and by b, each (E, 6, 6), so that the sum of their squares is the information."""
    root = np.sqrt(weights)[:, None, None]
    by_a, by_b = jacobians(residuals_at, edges)
    return by_a * root, by_b * root


def _gauss_newton_step(
    equations: NormalEquations,
    residuals_at: EdgeResiduals,
    edges: EdgeArrays,
    unary: tuple[F64, F64],
    damping: float,
    config: GraphConfig,
) -> F64:
    weights = _cauchy_weights(residuals_at, edges, config)
    J, softness = weighted_jacobians(residuals_at, weights, edges), np.ones(len(edges))
    if not damping:
        J, softness = _triggs_correction(J, residuals_at, weights, edges)
    whitened = residuals_at.whitened * (np.sqrt(weights) / softness)[:, None]
    try:
        return equations.solve_step(J, whitened, unary, damping, config.inner_tolerance)
    except np.linalg.LinAlgError:
        return np.full((len(equations), 6), np.nan)


def _triggs_correction(
    J: tuple[F64, F64], residuals_at: EdgeResiduals, weights: F64, edges: EdgeArrays
) -> tuple[tuple[F64, F64], F64]:
    """Jacobians less stiff along each loop's residual, where the kernel bends away, and by how much (E,):
    without that the last millimetres take many steps (Triggs et al., section 4.3). Not for loops so
    far off that the kernel is not convex there: they need it stiff."""
    is_convex = edges.is_loop & (weights > 0.5)
    softness = np.where(is_convex, np.sqrt(np.maximum(2 * weights - 1, _MIN_CURVATURE)), 1.0)
    along = residuals_at.whitened / np.sqrt(np.maximum(residuals_at.chi2, 1e-300))[:, None]
    reduction = ((1 - softness)[:, None] * along)[:, :, None]
    by_a, by_b = (each - reduction * (along[:, None, :] @ each) for each in J)
    return (by_a, by_b), softness


def _cauchy_weights(residuals_at: EdgeResiduals, edges: EdgeArrays, config: GraphConfig) -> F64:
    """Of Cauchy's kernel: 1 / (1 + chi2 / width^2) for loops."""
    return np.where(edges.is_loop, 1 / (1 + residuals_at.chi2 / config.cauchy**2), 1.0)


def _robust_cost(residuals_at: EdgeResiduals, edges: EdgeArrays, config: GraphConfig) -> float:
    width = config.cauchy**2
    return float(
        np.where(edges.is_loop, width * np.log1p(residuals_at.chi2 / width), residuals_at.chi2).sum()
    )


MAX_CG_ITERATIONS = 300  # of conjugate gradients; where they end early the step is still downhill


def chain_order(n: int, odometry: EdgeArrays) -> I64:
    """Which of n poses comes k-th (n,), so that neighbours by odometry are neighbours, but where it forks."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    a, b = np.concatenate([odometry.a, odometry.b]), np.concatenate([odometry.b, odometry.a])
    graph = csr_array((np.ones(len(a)), (a, b)), shape=(n, n))
    return np.asarray(reverse_cuthill_mckee(graph, symmetric_mode=True), np.int64)


class NormalEquations:
    """What stays the same while the edges of n poses, in `chain_order`, are linearised again and
    again: which block goes where. Pose `held` moves only as projector `gauge_projector` (6, 6) lets it."""

    def __init__(self, n: int, edges: EdgeArrays, anchor_index: int, gauge_projector: F64) -> None:
        from scipy.sparse import csr_array

        a, b, e = edges.a, edges.b, len(edges)
        self._n, self._anchor, self._gauge_projector = n, anchor_index, gauge_projector
        ends = np.concatenate([a, b])
        self._at_anchor = np.flatnonzero(ends == anchor_index)
        self._gather = csr_array((np.ones(2 * e), (ends, np.arange(2 * e))), shape=(n, 2 * e))
        rows, columns = np.concatenate([np.arange(n), ends]), np.concatenate([np.arange(n), b, a])
        self._order = np.lexsort((columns, rows))
        self._columns = columns[self._order]
        self._starts = np.searchsorted(rows[self._order], np.arange(n + 1))
        self._forward, self._backward = np.flatnonzero(b == a + 1), np.flatnonzero(a == b + 1)
        upper = np.concatenate([a[self._forward], b[self._backward]])
        shape = n, len(upper)
        self._couple = csr_array((np.ones(len(upper)), (upper, np.arange(len(upper)))), shape=shape)

    def __len__(self) -> int:
        return self._n

    def solve_step(
        self,
        J: tuple[F64, F64],
        whitened: F64,
        unary: tuple[F64, F64],
        damping: float,
        tolerance: float,
    ) -> F64:
        """The perturbations (n, 6) that solve the equations with their diagonal raised by `damping`.

        J: two (E, 6, 6); whitened (E, 6). own: slope (n, 6) and curvature (n, 6, 6) of what each pose knows
        without an edge. tolerance: of the equations' residual, relative. Raises np.linalg.LinAlgError if
        the chains cannot be solved.
        """
        from scipy.sparse.linalg import LinearOperator, cg

        gradient, diagonal, coupling = self._blocks(J, whitened, unary)
        diagonal[:, range(6), range(6)] *= 1 + damping
        matrix = self._sparse_matrix(diagonal, coupling)
        chains = _factorise_band(self._chain_band(diagonal, coupling))
        preconditioner = LinearOperator(matrix.shape, lambda x: _solve_band(chains, x), dtype=np.float64)
        step, _ = cg(matrix, -gradient.ravel(), rtol=tolerance, maxiter=MAX_CG_ITERATIONS, M=preconditioner)
        return np.asarray(step.reshape(-1, 6))

    def information_matrix(self, J: tuple[F64, F64], unary: tuple[F64, F64]) -> Any:
        """J'J as a sparse matrix (6 n, 6 n), the identity where the held pose is not free."""
        _, diagonal, coupling = self._blocks(J, np.zeros((len(J[0]), 6)), unary)
        matrix = self._sparse_matrix(diagonal, coupling).tocsc()
        matrix.sum_duplicates()
        return matrix

    def _sparse_matrix(self, diagonal: F64, coupling: F64) -> Any:
        from scipy.sparse import bsr_array

        blocks = np.concatenate([diagonal, coupling, np.swapaxes(coupling, 1, 2)])[self._order]
        return bsr_array((blocks, self._columns, self._starts), shape=(6 * self._n,) * 2)

    def _blocks(self, J: tuple[F64, F64], whitened: F64, unary: tuple[F64, F64]) -> tuple[F64, F64, F64]:
        """J'r (n, 6), and of J'J the blocks on the diagonal (n, 6, 6) and at every (a, b) (E, 6, 6)."""
        stacked = np.concatenate(J)
        stacked[self._at_anchor] = stacked[self._at_anchor] @ self._gauge_projector
        transposed = np.swapaxes(stacked, 1, 2)
        e = len(whitened)
        edge_gradients = (transposed.reshape(2, e, 6, 6) @ whitened[:, :, None]).reshape(2 * e, 6)
        squares = (transposed @ stacked).reshape(2 * e, 36)
        gradient, hessian = unary
        gradient = self._gather @ edge_gradients + gradient
        diagonal = (self._gather @ squares).reshape(-1, 6, 6) + hessian
        anchor, gauge_projector = self._anchor, self._gauge_projector
        gradient[anchor] = gauge_projector @ gradient[anchor]
        diagonal[anchor] = gauge_projector @ diagonal[anchor] @ gauge_projector + np.eye(6) - gauge_projector
        return gradient, diagonal, transposed[:e] @ stacked[e:]

    def _chain_band(self, diagonal: F64, coupling: F64) -> F64:
        """LAPACK's lower band (12, 6 n) of the blocks on the diagonal and next to it."""
        forward = np.swapaxes(coupling[self._forward], 1, 2)
        subdiagonal = self._couple @ np.concatenate([forward, coupling[self._backward]]).reshape(-1, 36)
        columns = np.concatenate([diagonal, subdiagonal.reshape(-1, 6, 6)], 1)
        band = np.zeros((12, 6 * self._n))
        for j in range(6):
            band[: 12 - j, j::6] = columns[:, j:, j].T
        return band


def _factorise_band(band: F64) -> F64:
    from scipy.linalg.lapack import dpbtrf

    factor, info = dpbtrf(band, lower=1)
    if info:
        raise np.linalg.LinAlgError("the chains' equations have no solution")
    return np.asarray(factor)


def _solve_band(factor: F64, x: F64) -> F64:
    from scipy.linalg.lapack import dpbtrs

    return np.asarray(dpbtrs(factor, x, lower=1)[0])
