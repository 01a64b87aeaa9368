"""Add keyframes and features to the state, and marginalise them. Each function changes the state in place.

Source: stochastic cloning with an unknown time offset, Li & Mourikis (2014).
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from share.odometry.filter import twist
from share.odometry.state import CORE_SIZE, POSE, TIMESHIFT, FilterState
from share.types import F64, I64

Float = TypeVar("Float", bound=np.floating[Any])


def add_keyframe(state: FilterState, keyframe_id: int, rate: F64) -> int:
    """Clone the body's pose at the time of the image, which depends on the time offset. Return its index.

    rate (3,): rad/s of the body.
    """
    n, start = state.size, state.features_start
    J = np.zeros((6, n))
    J[:, POSE] = np.eye(6)
    J[:, TIMESHIFT] = twist(state, rate)
    rows = J @ state.cov
    grown = _insert_zeros(state.cov, start, 6)
    for old, new in ((slice(0, start), slice(0, start)), (slice(start, n), slice(start + 6, n + 6))):
        grown[start : start + 6, new], grown[new, start : start + 6] = rows[:, old], rows[:, old].T
    grown[start : start + 6, start : start + 6] = rows @ J.T
    state.cov = grown
    state.keyframe_ids = np.append(state.keyframe_ids, keyframe_id)
    state.keyframe_poses = np.concatenate([state.keyframe_poses, state.T[None]])
    return len(state.keyframe_ids) - 1


def add_features(
    state: FilterState,
    ids: I64,
    anchor: I64,
    ray: F64,
    rho: F64,
    sigma: F64,
    J_existing: F64 | None = None,
    common_sigma: F64 | None = None,
) -> None:
    """Add features (N,) on rays (N, 2) of the keyframes with indices `anchor` (N,), with inverse depths rho
    (N,) 1/m.

    sigma (N,): independent error of each. J_existing (N, M): derivative by the M inverse depths of the state.
    common_sigma (N,): sigma of an error that the new ones share.
    """
    n, count = state.size, len(ids)
    grown = _insert_zeros(state.cov, n, count)
    new = slice(n, n + count)
    if J_existing is not None and J_existing.shape[1]:
        rows = J_existing @ state.cov[state.features_start :]
        grown[new, :n], grown[:n, new] = rows, rows.T
        grown[new, new] = rows[:, state.features_start :] @ J_existing.T
    diagonal = np.arange(n, n + count)
    grown[diagonal, diagonal] += sigma**2
    if common_sigma is not None and common_sigma.any():
        grown[new, new] += np.outer(common_sigma, common_sigma)
    state.cov = grown
    state.feature_ids = np.concatenate([state.feature_ids, ids])
    state.anchor = np.concatenate([state.anchor, anchor])
    state.ray = np.concatenate([state.ray, ray])
    state.rho = np.concatenate([state.rho, rho])


def keep_features(state: FilterState, keep: NDArray[np.bool_]) -> None:
    """Marginalise the features where `keep` (N,) is False."""
    if keep.all():
        return
    _keep_columns(state, np.concatenate([np.ones(state.features_start, bool), keep]))
    state.feature_ids, state.anchor = state.feature_ids[keep], state.anchor[keep]
    state.ray, state.rho = state.ray[keep], state.rho[keep]


def drop_keyframes(state: FilterState, keyframe_ids: I64) -> None:
    """Marginalise the keyframes with these ids, and the features anchored in them."""
    dropped = np.isin(state.keyframe_ids, keyframe_ids)
    if not dropped.any():
        return
    keep = ~dropped[state.anchor]
    _keep_columns(state, np.concatenate([np.ones(CORE_SIZE, bool), np.repeat(~dropped, 6), keep]))
    state.feature_ids, state.ray, state.rho = state.feature_ids[keep], state.ray[keep], state.rho[keep]
    state.anchor = (np.cumsum(~dropped) - 1)[state.anchor[keep]]
    state.keyframe_ids, state.keyframe_poses = state.keyframe_ids[~dropped], state.keyframe_poses[~dropped]


def _keep_columns(state: FilterState, keep: NDArray[np.bool_]) -> None:
    state.cov = submatrix(state.cov, np.flatnonzero(keep))


def submatrix(matrix: NDArray[Float], indices: I64) -> NDArray[Float]:
    """Return the rows and columns `indices` of a square matrix; faster than with `np.ix_`."""
    return matrix.take(indices, axis=0).take(indices, axis=1)


def _insert_zeros(cov: F64, start: int, count: int) -> F64:
    """Return the covariance with `count` rows and columns of zeros inserted before column `start`."""
    n = len(cov)
    out = np.zeros((n + count, n + count))
    out[:start, :start], out[:start, start + count :] = cov[:start, :start], cov[:start, start:]
    out[start + count :, :start] = cov[start:, :start]
    out[start + count :, start + count :] = cov[start:, start:]
    return out
