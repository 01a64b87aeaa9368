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
from share.mapping.graph.edges import Edges, Residuals, jacobians, residuals, tilting
from share.mapping.graph.edges import cost as plumb_cost
from share.mapping.graph.edges import equations as plumb_equations
from share.types import F64, I64

# ---- Levenberg-Marquardt on re-weighted least squares: the most likely poses of one connected part.
#
# Odometry is Gaussian; loops are under a Cauchy kernel, since one false loop must not bend the map. Source:
# Triggs et al., *Bundle Adjustment: A Modern Synthesis*, 2000; Cauchy against 30 % false loops:
# docs/edge-map.md.

_FIRST_DAMPING, _MOST_DAMPING = 1e-4, 1e8
_LEAST_CURVATURE = 0.5  # of a loop along its residual, beside that across; 0.3 overshot at times


@dataclass(frozen=True, eq=False)
class Minimum:
    """poses (N, 4, 4). free (6, 6): what the held pose may do, a projector. at: the residuals there. weights
    (E,): what the kernel leaves of each edge's information. reason: why there is no minimum and the poses
    are as they were, or empty."""

    poses: F64
    free: F64
    at: Residuals
    weights: F64
    iterations: int
    reason: str = ""


def minimise(poses: F64, plumb: F64, edges: Edges, held: int, config: GraphConfig) -> Minimum:
    """From poses (N, 4, 4), in `chain_order`, with `share.mapping.graph.edges` (N, 3) each. Pose `held`
    stays, to the bit where no plumb line is known; where one is, it tilts about its place. Deterministic."""
    with np.errstate(all="ignore"):
        return _minimise(poses, plumb, edges, held, config)


def _minimise(poses: F64, plumb: F64, edges: Edges, held: int, config: GraphConfig) -> Minimum:
    at, damping, iterations = residuals(poses, edges), 0.0, 0
    free = tilting(poses[held]) if plumb.any() else np.zeros((6, 6))

    def cost_of(at: Residuals, poses: F64) -> float:
        return _cost(at, edges, config) + plumb_cost(poses, plumb)

    cost = cost_of(at, poses)
    if not np.isfinite(cost):
        why = "the error is not finite to begin with"
        return Minimum(poses, free, at, _weights(at, edges, config), 0, why)
    equations = Equations(len(poses), edges, held, free)
    while (len(edges) or free.any()) and iterations < config.max_iterations and damping <= _MOST_DAMPING:
        iterations += 1
        step = _step(equations, at, edges, plumb_equations(poses, plumb), damping, config)
        moved = poses @ se3.exp(step)
        there = residuals(moved, edges)
        lower = cost_of(there, moved)
        if not lower <= cost:  # nor if it is not finite
            damping = max(10 * damping, _FIRST_DAMPING)
            continue
        gain, cost, poses, at = cost - lower, lower, moved, there
        damping = damping / 10 if damping > _FIRST_DAMPING else 0.0
        if np.abs(step).max() < config.step_tolerance or gain <= config.relative_tolerance * cost:
            break
    return Minimum(poses, free, at, _weights(at, edges, config), iterations)


def weighted_jacobians(at: Residuals, weights: F64, edges: Edges) -> tuple[F64, F64]:
    """By a and by b, each (E, 6, 6), so that the sum of their squares is the information."""
    root = np.sqrt(weights)[:, None, None]
    by_a, by_b = jacobians(at, edges)
    return by_a * root, by_b * root


def _step(
    equations: Equations,
    at: Residuals,
    edges: Edges,
    own: tuple[F64, F64],
    damping: float,
    config: GraphConfig,
) -> F64:
    weights = _weights(at, edges, config)
    J, softness = weighted_jacobians(at, weights, edges), np.ones(len(edges))
    if not damping:
        J, softness = _softened(J, at, weights, edges)
    whitened = at.whitened * (np.sqrt(weights) / softness)[:, None]
    try:
        return equations.step(J, whitened, own, damping, config.inner_tolerance)
    except np.linalg.LinAlgError:
        return np.full((len(equations), 6), np.nan)


def _softened(J: tuple[F64, F64], at: Residuals, weights: F64, edges: Edges) -> tuple[tuple[F64, F64], F64]:
    """Jacobians less stiff along each loop's residual, where the kernel bends away, and by how much (E,):
    without that the last millimetres take many steps (Triggs et al., section 4.3). Not for loops so
    far off that the kernel is not convex there: they need it stiff."""
    near = edges.is_loop & (weights > 0.5)
    softness = np.where(near, np.sqrt(np.maximum(2 * weights - 1, _LEAST_CURVATURE)), 1.0)
    along = at.whitened / np.sqrt(np.maximum(at.chi2, 1e-300))[:, None]
    cut = ((1 - softness)[:, None] * along)[:, :, None]
    by_a, by_b = (each - cut * (along[:, None, :] @ each) for each in J)
    return (by_a, by_b), softness


def _weights(at: Residuals, edges: Edges, config: GraphConfig) -> F64:
    """Of Cauchy's kernel: 1 / (1 + chi2 / width^2) for loops."""
    return np.where(edges.is_loop, 1 / (1 + at.chi2 / config.cauchy**2), 1.0)


def _cost(at: Residuals, edges: Edges, config: GraphConfig) -> float:
    width = config.cauchy**2
    return float(np.where(edges.is_loop, width * np.log1p(at.chi2 / width), at.chi2).sum())


MOST_ITERATIONS = 300  # of conjugate gradients; where they end early the step is still downhill


def chain_order(n: int, odometry: Edges) -> I64:
    """Which of n poses comes k-th (n,), so that neighbours by odometry are neighbours, but where it forks."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    a, b = np.concatenate([odometry.a, odometry.b]), np.concatenate([odometry.b, odometry.a])
    graph = csr_array((np.ones(len(a)), (a, b)), shape=(n, n))
    return np.asarray(reverse_cuthill_mckee(graph, symmetric_mode=True), np.int64)


class Equations:
    """What stays the same while the edges of n poses, in `chain_order`, are linearised again and
    again: which block goes where. Pose `held` moves only as projector `free` (6, 6) lets it."""

    def __init__(self, n: int, edges: Edges, held: int, free: F64) -> None:
        from scipy.sparse import csr_array

        a, b, e = edges.a, edges.b, len(edges)
        self._n, self._held, self._free = n, held, free
        ends = np.concatenate([a, b])
        self._at_held = np.flatnonzero(ends == held)
        self._gather = csr_array((np.ones(2 * e), (ends, np.arange(2 * e))), shape=(n, 2 * e))
        rows, columns = np.concatenate([np.arange(n), ends]), np.concatenate([np.arange(n), b, a])
        self._order = np.lexsort((columns, rows))
        self._columns = columns[self._order]
        self._starts = np.searchsorted(rows[self._order], np.arange(n + 1))
        self._onward, self._backward = np.flatnonzero(b == a + 1), np.flatnonzero(a == b + 1)
        upper = np.concatenate([a[self._onward], b[self._backward]])
        shape = n, len(upper)
        self._next = csr_array((np.ones(len(upper)), (upper, np.arange(len(upper)))), shape=shape)

    def __len__(self) -> int:
        return self._n

    def step(
        self,
        J: tuple[F64, F64],
        whitened: F64,
        own: tuple[F64, F64],
        damping: float,
        tolerance: float,
    ) -> F64:
        """The perturbations (n, 6) that solve the equations with their diagonal raised by `damping`.

        J: two (E, 6, 6); whitened (E, 6). own: slope (n, 6) and curvature (n, 6, 6) of what each pose knows
        without an edge. tolerance: of the equations' residual, relative. Raises np.linalg.LinAlgError if
        the chains cannot be solved.
        """
        from scipy.sparse.linalg import LinearOperator, cg

        slope, diagonal, coupling = self._blocks(J, whitened, own)
        diagonal[:, range(6), range(6)] *= 1 + damping
        whole = self._whole(diagonal, coupling)
        chains = _factorised(self._band(diagonal, coupling))
        easy = LinearOperator(whole.shape, lambda x: _substituted(chains, x), dtype=np.float64)
        step, _ = cg(whole, -slope.ravel(), rtol=tolerance, maxiter=MOST_ITERATIONS, M=easy)
        return np.asarray(step.reshape(-1, 6))

    def information(self, J: tuple[F64, F64], own: tuple[F64, F64]) -> Any:
        """J'J as a sparse matrix (6 n, 6 n), the identity where the held pose is not free."""
        _, diagonal, coupling = self._blocks(J, np.zeros((len(J[0]), 6)), own)
        whole = self._whole(diagonal, coupling).tocsc()
        whole.sum_duplicates()
        return whole

    def _whole(self, diagonal: F64, coupling: F64) -> Any:
        from scipy.sparse import bsr_array

        blocks = np.concatenate([diagonal, coupling, np.swapaxes(coupling, 1, 2)])[self._order]
        return bsr_array((blocks, self._columns, self._starts), shape=(6 * self._n,) * 2)

    def _blocks(self, J: tuple[F64, F64], whitened: F64, own: tuple[F64, F64]) -> tuple[F64, F64, F64]:
        """J'r (n, 6), and of J'J the blocks on the diagonal (n, 6, 6) and at every (a, b) (E, 6, 6)."""
        both = np.concatenate(J)
        both[self._at_held] = both[self._at_held] @ self._free
        transposed = np.swapaxes(both, 1, 2)
        e = len(whitened)
        pull = (transposed.reshape(2, e, 6, 6) @ whitened[:, :, None]).reshape(2 * e, 6)
        squares = (transposed @ both).reshape(2 * e, 36)
        slope, curvature = own
        slope = self._gather @ pull + slope
        diagonal = (self._gather @ squares).reshape(-1, 6, 6) + curvature
        held, free = self._held, self._free
        slope[held] = free @ slope[held]
        diagonal[held] = free @ diagonal[held] @ free + np.eye(6) - free
        return slope, diagonal, transposed[:e] @ both[e:]

    def _band(self, diagonal: F64, coupling: F64) -> F64:
        """LAPACK's lower band (12, 6 n) of the blocks on the diagonal and next to it."""
        onward = np.swapaxes(coupling[self._onward], 1, 2)
        below = self._next @ np.concatenate([onward, coupling[self._backward]]).reshape(-1, 36)
        columns = np.concatenate([diagonal, below.reshape(-1, 6, 6)], 1)
        band = np.zeros((12, 6 * self._n))
        for j in range(6):
            band[: 12 - j, j::6] = columns[:, j:, j].T
        return band


def _factorised(band: F64) -> F64:
    from scipy.linalg.lapack import dpbtrf

    factor, info = dpbtrf(band, lower=1)
    if info:
        raise np.linalg.LinAlgError("the chains' equations have no solution")
    return np.asarray(factor)


def _substituted(factor: F64, x: F64) -> F64:
    from scipy.linalg.lapack import dpbtrs

    return np.asarray(dpbtrs(factor, x, lower=1)[0])
