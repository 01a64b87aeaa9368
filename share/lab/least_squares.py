"""Least squares of the calibrations: Levenberg-Marquardt, systems in arrow form, robust loss, covariances.

An arrow system has nodes coupled to their neighbours only, and a border coupled to all nodes. Banded Cholesky
factorisation of the nodes, Schur complement of the border (Triggs et al., *Bundle adjustment: a modern
synthesis*, 2000, 6.1): linear in the number of nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from share.types import F64

_INITIAL_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-4, 1e-12, 1e6
_UNDERFLOW = 1e-150  # denormal numbers are slow

State = TypeVar("State")
Linearised = TypeVar("Linearised")


@dataclass(frozen=True, eq=False)
class Minimum(Generic[State, Linearised]):
    """The state of least cost and its linearisation. converged: False if steps ran out."""

    state: State
    linearised: Linearised
    converged: bool


def minimise(
    state: State,
    linearise: Callable[[State], tuple[Linearised, float]],
    step: Callable[[State, Linearised, float], State | None],
    max_steps: int,
    tolerance: float,
) -> Minimum[State, Linearised]:
    """Minimise a cost by Levenberg-Marquardt (Marquardt 1963).

    linearise: linearisation and cost at a state; a cost that is not finite rejects the state. step: the state
    after a step with the diagonals raised by the factor 1 + damping; None where that is no valid state.
    tolerance: relative decrease of the cost below which it has converged.

    Raises ValueError if the first cost is not finite, and what `step` raises.
    """
    linearised, cost = linearise(state)
    if not np.isfinite(cost):
        raise ValueError("the initial values do not fit the measurements")
    damping = _INITIAL_DAMPING
    for _ in range(max_steps):
        trial = step(state, linearised, damping)
        trial_linearised, trial_cost = (linearised, np.inf) if trial is None else linearise(trial)
        if trial is None or not trial_cost < cost:
            if damping > _MAX_DAMPING or trial_cost - cost < tolerance * cost:
                return Minimum(state, linearised, True)
            damping *= 10
            continue
        has_converged = cost - trial_cost < tolerance * cost
        state, linearised, cost = trial, trial_linearised, trial_cost
        if has_converged:
            return Minimum(state, linearised, True)
        damping = max(damping / 10, _MIN_DAMPING)
    return Minimum(state, linearised, False)


@dataclass(frozen=True, eq=False)
class ArrowSystem:
    """H x = g for N nodes of k unknowns, each coupled to the W - 1 nodes after it, and B unknowns coupled to
    all.

    blocks (N, W, k, k): of each node and itself, then of it and the nodes after it (those beyond the last are
    ignored). edge (N, k, B), corner (B, B), g_nodes (N, k), g_border (B,).
    """

    blocks: F64
    edge: F64
    corner: F64
    g_nodes: F64
    g_border: F64

    def solve(self, damping: float) -> tuple[F64, F64]:
        """Return the nodes (N, k) and the border (B,), with diagonals raised by the factor 1 + damping.

        Raises np.linalg.LinAlgError where an unknown is not observable.
        """
        return ArrowFactor(self, damping).solve(self.g_nodes, self.g_border)

    def node_covariances(self) -> F64:
        """Return the marginal covariances (N, k, k) of the nodes, for W = 2: the nodes' by forward and
        backward elimination, plus the effect of the border's uncertainty."""
        diagonal, ahead = self.blocks[:, 0], self.blocks[:, 1]
        forward, backward = diagonal.copy(), diagonal.copy()
        for i in range(1, len(diagonal)):
            L = ahead[i - 1].T
            forward[i] -= L @ np.linalg.solve(forward[i - 1], L.T)
            L = ahead[-1 - i]
            backward[-1 - i] -= L @ np.linalg.solve(backward[-i], L.T)
        factor = ArrowFactor(self)
        influence = factor.influence.reshape(self.edge.shape)
        out = np.linalg.inv(forward + backward - diagonal)
        return np.asarray(out + influence @ factor.border_covariance @ influence.swapaxes(1, 2), np.float64)


class ArrowFactor:
    """A factorised arrow system, with diagonals raised by the factor 1 + damping.

    border_covariance (B, B). influence (N k, B): by how much a node falls as the border rises. Raises
    np.linalg.LinAlgError where an unknown is not observable.
    """

    def __init__(self, system: ArrowSystem, damping: float = 0.0) -> None:
        from scipy.linalg import cholesky_banded

        band = _banded(system.blocks)
        band[-1] *= 1 + damping
        self._band = cholesky_banded(band)
        self._edge = system.edge.reshape(band.shape[1], -1)
        self.influence = self._solve_band(self._edge)
        corner = system.corner + damping * np.diag(np.diag(system.corner))
        covariance = np.linalg.inv(corner - self._edge.T @ self.influence)
        self.border_covariance = (covariance + covariance.T) / 2

    def solve(self, g_nodes: F64, g_border: F64) -> tuple[F64, F64]:
        """Return nodes (N, k, ...) and border (B, ...) for gradients of the same shapes."""
        nodes = self._solve_band(g_nodes.reshape(len(self._edge), -1))
        reduced = g_border.reshape(len(g_border), -1) - self._edge.T @ nodes
        border = self.border_covariance @ reduced
        return (nodes - self.influence @ border).reshape(g_nodes.shape), border.reshape(g_border.shape)

    def _solve_band(self, right: F64) -> F64:
        from scipy.linalg import cho_solve_banded

        out: F64 = cho_solve_banded((self._band, False), right)
        out[np.abs(out) < _UNDERFLOW] = 0
        return out


def _banded(blocks: F64) -> F64:
    """Return blocks (N, W, k, k) as LAPACK's upper band (W k, N k)."""
    N, W, k, _ = blocks.shape
    out = np.zeros((W * k, N * k))
    for ahead in range(min(W, N)):
        for i in range(k):
            for j in range(k):
                diagonal = k * ahead + j - i
                if diagonal >= 0:
                    out[-1 - diagonal, k * ahead + j :: k] = blocks[: N - ahead, ahead, i, j]
    return out


def huber(norms: F64, limit: float) -> tuple[float, F64]:
    """Return Huber's cost of residual norms (N,), infinite if one is NaN, and the square roots (N,) of their
    weights: 1 up to `limit`."""
    cost = np.where(norms <= limit, norms * norms / 2, limit * (norms - limit / 2)).sum()
    root_weights = np.sqrt(np.minimum(1, limit / np.maximum(norms, 1e-12)))
    return np.inf if np.isnan(cost) else float(cost), root_weights


def jackknife(H: F64, g: F64) -> F64:
    """Return the covariance (S, S) of parameters that V views determine together by H (V, S, S) and g (V, S)
    each, from how far the solution moves without each view (MacKinnon, Nielsen and Webb, *Cluster-robust
    inference*, 2023: CV3).

    With few views it has low rank.
    """
    moved = np.linalg.solve(H.sum(axis=0) - H, g[..., None])[..., 0]
    out: F64 = (1 - 1 / len(H)) * moved.T @ moved
    return out


def enclosing_covariance(one: F64, other: F64) -> F64:
    """Return a covariance (S, S) that is in no direction below `one`, which is positive definite, nor below
    `other`.

    Where `one` is the unit ball, principal axes of `other` shorter than 1 become 1.
    """
    root = np.linalg.cholesky(one)
    whitened = np.linalg.solve(root, np.linalg.solve(root, other).T)
    squares, axes = np.linalg.eigh((whitened + whitened.T) / 2)
    axes_back = root @ axes * np.sqrt(np.maximum(squares, 1))
    out: F64 = axes_back @ axes_back.T
    return out
