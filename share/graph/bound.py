"""How well poses are known from one of them: an upper bound that hardly exceeds the truth.

The exact covariance costs a factorisation of the whole graph. But what is left out of a graph can
only have told more, so the covariance in a part of it is an upper bound. The part that says most
is that along the surest ways: once found, their edges are made dearer, and the next surest ways
are added, until there are enough edges.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from share.graph.chains import Equations
from share.graph.descent import Minimum, weighted_jacobians
from share.graph.linear import Edges
from share.graph.ways import Ways, on_the_way
from share.types import F64, I64

MOST_ROUNDS = 16


def covariances(n: int, edges: Edges, at: Minimum, anchor: int, wanted: I64, enough: int) -> F64:
    """Covariances (K, 6, 6) of `wanted` (K,) of n poses relative to `anchor`, right perturbation.

    The part has `enough` edges if there are so many ways. Every wanted pose must be joined to the
    anchor; where the minimum is none, all are infinite.
    """
    out = np.zeros((len(wanted), 6, 6))
    free = np.flatnonzero(wanted != anchor)
    if not len(free):
        return out
    part = _surest(n, edges, edges.spread / at.weights, anchor, wanted[free], enough)
    poses = np.unique(np.concatenate([edges.a[part], edges.b[part]]))
    inside = edges[part].between(*(np.searchsorted(poses, end[part]) for end in (edges.a, edges.b)))
    equations = Equations(len(poses), inside, int(np.searchsorted(poses, anchor)))
    J = weighted_jacobians(at.at[part], at.weights[part], inside)
    out[free] = _blocks_of_inverse(equations.information(J), np.searchsorted(poses, wanted[free]))
    return out


def _surest(n: int, edges: Edges, cost: F64, anchor: int, wanted: I64, enough: int) -> I64:
    """Indices of the edges on the surest ways from the anchor to the wanted poses."""
    used, dear = np.zeros(len(edges), bool), cost.copy()
    for _ in range(MOST_ROUNDS):
        ways = Ways(n, edges.a, edges.b, dear)
        before = ways.before(anchor)
        met = on_the_way(before, wanted)
        walked = ways.edges(before[met], met)
        used[walked] = True
        dear[walked] += 2 * cost[walked]
        if used.sum() >= enough:
            break
    return np.flatnonzero(used)


def _blocks_of_inverse(information: Any, wanted: I64) -> F64:
    """Those on the diagonal (K, 6, 6)."""
    from scipy.sparse.linalg import splu

    symmetric = {"SymmetricMode": True}
    factor = splu(information, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
    rows = 6 * wanted[:, None] + np.arange(6)
    k = len(wanted)
    right = np.zeros((information.shape[0], 6 * k))
    right[rows.ravel(), np.arange(6 * k)] = 1
    blocks = factor.solve(right)[rows.ravel()].reshape(k, 6, k, 6)
    return np.asarray(blocks[np.arange(k), :, np.arange(k)])
