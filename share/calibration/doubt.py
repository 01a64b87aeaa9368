"""How far parameters that many views tell together may be off, also where a view's residuals err together."""

from __future__ import annotations

import numpy as np

from share.types import F64


def jackknife(H: F64, g: F64) -> F64:
    """Covariance (S, S) of what V views tell together by H (V, S, S) and g (V, S) each, by how far it moves
    without each of them (MacKinnon, Nielsen and Webb, *Cluster-robust inference*, 2023: CV3). Of few views
    it knows few directions."""
    moved = np.linalg.solve(H.sum(axis=0) - H, g[..., None])[..., 0]
    out: F64 = (1 - 1 / len(H)) * moved.T @ moved
    return out


def larger(one: F64, other: F64) -> F64:
    """A covariance (S, S) in no direction below `one`, which is positive definite, nor below `other`: where
    `one` is a unit ball, the principal axes of `other` that are shorter than 1 are made 1."""
    root = np.linalg.cholesky(one)
    inside = np.linalg.solve(root, np.linalg.solve(root, other).T)
    squares, axes = np.linalg.eigh((inside + inside.T) / 2)
    back = root @ axes * np.sqrt(np.maximum(squares, 1))
    out: F64 = back @ back.T
    return out
