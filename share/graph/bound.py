"""How well poses are known from one of them: an upper bound that hardly exceeds the truth.

The exact covariance costs a factorisation of the whole graph. But what is left out of a graph can
only have told more, so the covariance in a part of it is an upper bound. The part that says most
is that along the surest ways: once found, their edges are made dearer, and the next surest ways
are added, until there are enough edges.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from share.config import GraphConfig
from share.graph.chains import Equations
from share.graph.descent import Minimum, weighted_jacobians
from share.graph.linear import Edges
from share.graph.plumb import equations as plumb_equations
from share.graph.ways import Ways, on_the_way
from share.types import F64, I64

_LEAST_WEIGHT = 1e-9  # of a loop that all else speaks against, so that it can be divided by
_UNKNOWN = 1e6 * np.eye(6)


def covariances(edges: Edges, plumb: F64, at: Minimum, anchor: int, wanted: I64, config: GraphConfig) -> F64:
    """Covariances (K, 6, 6) of `wanted` (K,) of n poses relative to `anchor`, right perturbation.

    plumb (n, 3): see `share.graph.plumb`; where there are any, tilts are relative to gravity.

    Every wanted pose must be joined to the anchor. Where edges differ so much in certainty (beyond some
    16 orders of magnitude) that nothing can be told, a sigma of 1000 rad and m says so.
    """
    n, out = len(plumb), np.zeros((len(wanted), 6, 6))
    free = np.flatnonzero(wanted != anchor)
    if not len(free):
        return out
    weights = np.maximum(at.weights, _LEAST_WEIGHT)
    part = _surest(n, edges, edges.spread / weights, anchor, wanted[free], config)
    poses = np.unique(np.concatenate([edges.a[part], edges.b[part]]))
    inside = edges[part].between(*(np.searchsorted(poses, end[part]) for end in (edges.a, edges.b)))
    equations = Equations(len(poses), inside, int(np.searchsorted(poses, anchor)), at.free)
    J = weighted_jacobians(at.at[part], weights[part], inside)
    own = plumb_equations(at.poses[poses], plumb[poses])
    out[free] = _blocks_of_inverse(equations.information(J, own), np.searchsorted(poses, wanted[free]))
    return out


def _surest(n: int, edges: Edges, cost: F64, anchor: int, wanted: I64, config: GraphConfig) -> I64:
    """Indices of the edges on the surest ways from the anchor to the wanted poses."""
    used, dear = np.zeros(len(edges), bool), cost.copy()
    for _ in range(config.covariance_rounds):
        ways = Ways(n, edges.a, edges.b, dear)
        before = ways.before(anchor)
        met = on_the_way(before, wanted)
        walked = ways.edges(before[met], met)
        used[walked] = True
        dear[walked] += 2 * cost[walked]
        if used.sum() >= config.covariance_edges:
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
    blocks = blocks[np.arange(k), :, np.arange(k)]
    blocks = (blocks + np.swapaxes(blocks, 1, 2)) / 2
    told = np.linalg.eigvalsh(blocks)[:, 0] > 0
    return np.where(told[:, None, None], blocks, _UNKNOWN)
