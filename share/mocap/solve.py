"""Normal equations of a chain of nodes that also shares a few unknowns: a band with a border.

The band is factored once (Cholesky), the border is eliminated by its Schur complement: linear in the
number of nodes. Source: Golub and Van Loan, *Matrix Computations*, 4th ed., 4.3.5 and 3.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.mocap.factors import Chain, Sightings
from share.mocap.state import NODE, SHARED
from share.types import F64


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
