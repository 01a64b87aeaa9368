"""Rigid alignment of two point sets."""

from __future__ import annotations

import numpy as np

from share.geometry.se3 import compose
from share.types import F64


def umeyama(source: F64, target: F64) -> F64:
    """T (4, 4) that minimises sum |target - T source|^2 over rigid transforms (no scale).

    source, target: (N, 3) m, N >= 1 (rotation is determined from three points not on a line).
    Source: Umeyama, PAMI 13(4), 1991, eq. 40-43 with c = 1.
    """
    if source.shape != target.shape or len(source) == 0:
        raise ValueError(f"umeyama: shapes {source.shape} and {target.shape} must agree and not be empty")
    ms, mt = source.mean(0), target.mean(0)
    R = rotation((target - mt).T @ (source - ms))
    return compose(R, mt - R @ ms)


def rotation(M: F64) -> F64:
    """The rotation R (3, 3) that maximises trace(R' M): of M = sum target source', what turns sources best to
    targets. Source: Umeyama, eq. 40 and 43."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt)
