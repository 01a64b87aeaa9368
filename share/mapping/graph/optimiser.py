"""Levenberg-Marquardt on a pose graph, with conjugate-gradient steps.

Odometry is Gaussian; loops are under a Cauchy kernel, so that a false loop does not bend the map. Source:
Triggs et al., *Bundle Adjustment: A Modern Synthesis*, 2000; Cauchy against 30 % false loops:
docs/understand/mapping.md.

Odometry makes long chains, whose equations are block tridiagonal and solved in a millisecond. With the
information of all other edges added at both ends, they precondition the whole system; the coupling by loops
is left to a few ten iterations, however many loops there are, where a factorisation would fill in. Source:
Dellaert et al., *Subgraph-preconditioned Conjugate Gradients for Large Scale SLAM*, IROS 2010.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from share.geometry import se3
from share.mapping.graph.edges import EdgeArrays, EdgeResiduals, jacobians, residuals
from share.mapping.graph.gravity import gravity_cost, gravity_equations, tilt_projector
from share.types import F64, I64

MAX_ITERATIONS = 30  # the next solution continues from the result
RELATIVE_TOLERANCE = 1e-6  # of the cost, between two iterations
STEP_TOLERANCE = 3e-3  # rad and m; converged once no pose moves by more
INNER_TOLERANCE = 3e-2  # relative residual of the linear system of a step
_INITIAL_DAMPING = 1e-4
_MAX_DAMPING = 1e8
_MIN_CURVATURE = 0.5  # along a loop's residual, relative to that across; 0.3 overshot at times
MAX_CG_ITERATIONS = 300  # if they end early, the step is still downhill


@dataclass(frozen=True, eq=False)
class OptimisedPoses:
    """poses (N, 4, 4) and their residuals.

    gauge_projector (6, 6): how the anchor may move. weights (E,): factor of the kernel on each edge's
    information. reason: why there is no minimum, and poses are unchanged; or empty.
    """

    poses: F64
    gauge_projector: F64
    residuals: EdgeResiduals
    weights: F64
    iterations: int
    reason: str = ""


def optimise(
    poses: F64, gravity_factors: F64, edges: EdgeArrays, anchor_index: int, cauchy: float
) -> OptimisedPoses:
    """Optimise poses (N, 4, 4), in `chain_order`, with gravity factors (N, 3). Deterministic.

    cauchy: whitened residual at which a loop has half its weight.
    The anchor stays, to the bit without gravity factors; with any, it tilts in place.
    """
    with np.errstate(all="ignore"):
        return _levenberg_marquardt(poses, gravity_factors, edges, anchor_index, cauchy)


def _levenberg_marquardt(
    poses: F64, gravity_factors: F64, edges: EdgeArrays, anchor_index: int, cauchy: float
) -> OptimisedPoses:
    current, damping, iterations = residuals(poses, edges), 0.0, 0
    gauge_projector = tilt_projector(poses[anchor_index]) if gravity_factors.any() else np.zeros((6, 6))

    def cost_of(at: EdgeResiduals, poses: F64) -> float:
        return _robust_cost(at, edges, cauchy) + gravity_cost(poses, gravity_factors)

    cost = cost_of(current, poses)
    if not np.isfinite(cost):
        reason = "the cost of the initial poses is not finite"
        return OptimisedPoses(
            poses, gauge_projector, current, _cauchy_weights(current, edges, cauchy), 0, reason
        )
    equations = NormalEquations(len(poses), edges, anchor_index, gauge_projector)
    while (len(edges) or gauge_projector.any()) and iterations < MAX_ITERATIONS and damping <= _MAX_DAMPING:
        iterations += 1
        step = _gauss_newton_step(
            equations, current, edges, gravity_equations(poses, gravity_factors), damping, cauchy
        )
        trial_poses = poses @ se3.exp(step)
        trial = residuals(trial_poses, edges)
        trial_cost = cost_of(trial, trial_poses)
        if not trial_cost <= cost:  # also rejects a cost that is not finite
            damping = max(10 * damping, _INITIAL_DAMPING)
            continue
        gain, cost, poses, current = cost - trial_cost, trial_cost, trial_poses, trial
        damping = damping / 10 if damping > _INITIAL_DAMPING else 0.0
        if np.abs(step).max() < STEP_TOLERANCE or gain <= RELATIVE_TOLERANCE * cost:
            break
    return OptimisedPoses(
        poses, gauge_projector, current, _cauchy_weights(current, edges, cauchy), iterations
    )


def weighted_jacobians(residuals_at: EdgeResiduals, weights: F64, edges: EdgeArrays) -> tuple[F64, F64]:
    """Jacobians by a and b, each (E, 6, 6), scaled so that J'J is the information."""
    root = np.sqrt(weights)[:, None, None]
    by_a, by_b = jacobians(residuals_at, edges)
    return by_a * root, by_b * root


def _gauss_newton_step(
    equations: NormalEquations,
    residuals_at: EdgeResiduals,
    edges: EdgeArrays,
    unary: tuple[F64, F64],
    damping: float,
    cauchy: float,
) -> F64:
    weights = _cauchy_weights(residuals_at, edges, cauchy)
    J, softness = weighted_jacobians(residuals_at, weights, edges), np.ones(len(edges))
    if not damping:
        J, softness = _triggs_correction(J, residuals_at, weights, edges)
    whitened = residuals_at.whitened * (np.sqrt(weights) / softness)[:, None]
    try:
        return equations.solve_step(J, whitened, unary, damping, INNER_TOLERANCE)
    except np.linalg.LinAlgError:
        return np.full((len(equations), 6), np.nan)


def _triggs_correction(
    J: tuple[F64, F64], residuals_at: EdgeResiduals, weights: F64, edges: EdgeArrays
) -> tuple[tuple[F64, F64], F64]:
    """Soften the Jacobians along each loop's residual, where the kernel bends away; return also the factor
    (E,).

    Without it the last millimetres take many steps (Triggs et al., section 4.3). Loops in the non-convex part
    of the kernel are left as they are.
    """
    is_convex = edges.is_loop & (weights > 0.5)
    softness = np.where(is_convex, np.sqrt(np.maximum(2 * weights - 1, _MIN_CURVATURE)), 1.0)
    along = residuals_at.whitened / np.sqrt(np.maximum(residuals_at.chi2, 1e-300))[:, None]
    reduction = ((1 - softness)[:, None] * along)[:, :, None]
    by_a, by_b = (each - reduction * (along[:, None, :] @ each) for each in J)
    return (by_a, by_b), softness


def _cauchy_weights(residuals_at: EdgeResiduals, edges: EdgeArrays, cauchy: float) -> F64:
    """Weights of the Cauchy kernel: 1 / (1 + chi2 / width^2) for loops, else 1."""
    return np.where(edges.is_loop, 1 / (1 + residuals_at.chi2 / cauchy**2), 1.0)


def _robust_cost(residuals_at: EdgeResiduals, edges: EdgeArrays, cauchy: float) -> float:
    width = cauchy**2
    return float(
        np.where(edges.is_loop, width * np.log1p(residuals_at.chi2 / width), residuals_at.chi2).sum()
    )


def chain_order(n: int, odometry: EdgeArrays) -> I64:
    """Order (n,) of the poses in which odometry neighbours are adjacent, except at forks."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    a, b = np.concatenate([odometry.a, odometry.b]), np.concatenate([odometry.b, odometry.a])
    graph = csr_array((np.ones(len(a)), (a, b)), shape=(n, n))
    return np.asarray(reverse_cuthill_mckee(graph, symmetric_mode=True), np.int64)


class NormalEquations:
    """Sparsity pattern of the normal equations of n poses in `chain_order`, for repeated linearisation.

    The anchor moves only as `gauge_projector` (6, 6) allows.
    """

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
        """Return the perturbations (n, 6) that solve the equations with the diagonal raised by `damping`.

        J: two (E, 6, 6); whitened (E, 6). unary: gradient (n, 6) and Hessian (n, 6, 6) of the poses' own
        factors. tolerance: relative, of the residual. Raises np.linalg.LinAlgError if the chains cannot be
        factorised.
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
        """J'J as a sparse matrix (6 n, 6 n), the identity where the anchor is fixed."""
        _, diagonal, coupling = self._blocks(J, np.zeros((len(J[0]), 6)), unary)
        matrix = self._sparse_matrix(diagonal, coupling).tocsc()
        matrix.sum_duplicates()
        return matrix

    def _sparse_matrix(self, diagonal: F64, coupling: F64) -> Any:
        from scipy.sparse import bsr_array

        blocks = np.concatenate([diagonal, coupling, np.swapaxes(coupling, 1, 2)])[self._order]
        return bsr_array((blocks, self._columns, self._starts), shape=(6 * self._n,) * 2)

    def _blocks(self, J: tuple[F64, F64], whitened: F64, unary: tuple[F64, F64]) -> tuple[F64, F64, F64]:
        """J'r (n, 6), and of J'J the diagonal blocks (n, 6, 6) and those at every (a, b) (E, 6, 6)."""
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
        """Lower band (12, 6 n), as of LAPACK, of the blocks on and next to the diagonal."""
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
        raise np.linalg.LinAlgError("the equations along the odometry chains are not positive definite")
    return np.asarray(factor)


def _solve_band(factor: F64, x: F64) -> F64:
    from scipy.linalg.lapack import dpbtrs

    return np.asarray(dpbtrs(factor, x, lower=1)[0])
