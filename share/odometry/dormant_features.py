"""Dormant features: features out of view, kept with their anchor keyframes until they are in view again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from share.array_table import ArrayTable
from share.geometry import se3
from share.geometry.camera import Camera
from share.odometry import feature_matching, filter
from share.odometry.feature_appearance import Appearance
from share.odometry.state import CORE_SIZE, KEYFRAMES_START, FilterState
from share.types import F64, I64

_MAX_RELATIVE_SIGMA = 0.1  # of the inverse depth of a feature that is kept
_SIGMA_INFLATION = 1.5  # times its sigma, because its correlation with the poses is lost
_MAX_PER_KEYFRAME = 40  # features
_MAX_SEARCHED = 80  # features that a keyframe searches for again
_MAX_DISTANCE_M, _MAX_ANGLE_RAD = 1.5, 0.7  # from it to their anchor keyframes
_FREE = -1  # keyframe of a row without a feature


@dataclass(frozen=True, eq=False)
class DormantTable(ArrayTable):
    """N features: ids (N,), index of the anchor (N,), rays (N, 2), inverse depths and sigmas (N,) 1/m,
    appearance."""

    ids: I64
    anchor: I64
    ray: F64
    rho: F64
    sigma: F64
    appearance: Appearance


class DormantFeatures:
    """Dormant features in the rows of one table, whose free rows are used again: patches are copied once in
    and once out. Memory is bounded by the number of keyframes in the state."""

    def __init__(self) -> None:
        self._table: DormantTable | None = None
        # Of each row: id of the anchor keyframe, or `_FREE`; when it came, by which rows are ordered.
        self._keyframe, self._number = np.zeros((2, 0), np.int64)
        self._next_number = 0

    def deactivate(self, state: FilterState, appearance: Appearance, indices: I64) -> None:
        """Keep features `indices` of the state if their depth is well known."""
        if not len(indices):
            return
        sigma = _SIGMA_INFLATION * np.sqrt(state.rho_variance[indices])
        is_known = (sigma < _MAX_RELATIVE_SIGMA * np.abs(state.rho[indices])) | (sigma < 0.003)
        is_known &= appearance.age[indices] >= 5
        kept = indices[is_known]
        if not len(kept):
            return
        anchor = state.anchor[kept]
        dormant = DormantTable(
            state.feature_ids[kept],
            anchor,
            state.ray[kept],
            state.rho[kept],
            sigma[is_known],
            appearance.take(kept),
        )
        self._add(dormant, state.keyframe_ids[anchor])

    def _add(self, dormant: DormantTable, keyframe_ids: I64) -> None:
        count = len(dormant.ids)
        free = np.flatnonzero(self._keyframe == _FREE)[:count]
        if len(free) < count or self._table is None:
            grown = dormant if self._table is None else self._table.concatenate(self._table, dormant)
            added = len(grown.ids) - len(self._keyframe)
            self._keyframe = np.concatenate([self._keyframe, np.full(added, _FREE)])
            self._number = np.concatenate([self._number, np.zeros(added, np.int64)])
            self._table, free = grown, np.flatnonzero(self._keyframe == _FREE)[:count]
        self._table.put(free, dormant)
        self._keyframe[free] = keyframe_ids
        self._number[free] = np.arange(self._next_number, self._next_number + count)
        self._next_number += count
        for keyframe_id in np.unique(keyframe_ids).tolist():
            self._keep_most_certain(keyframe_id)

    def _keep_most_certain(self, keyframe_id: int) -> None:
        """Free the rows of the least certain features of a keyframe that has too many."""
        rows = np.flatnonzero(self._keyframe == keyframe_id)
        if self._table is None or len(rows) <= _MAX_PER_KEYFRAME:
            return
        rows = rows[np.argsort(self._number[rows])]
        by_sigma = np.argsort(self._table.sigma[rows], kind="stable")
        self._keyframe[rows[by_sigma[_MAX_PER_KEYFRAME:]]] = _FREE

    def has_features(self, keyframe_ids: I64) -> NDArray[np.bool_]:
        """Return which keyframes (K,) have dormant features."""
        return np.isin(keyframe_ids, self._keyframe)

    def drop_keyframes(self, keyframe_ids: I64) -> None:
        """Forget the features of these keyframes."""
        self._keyframe[np.isin(self._keyframe, keyframe_ids)] = _FREE

    def reactivate(self, ids: I64) -> None:
        """Remove the features with these ids: they are in the state again."""
        if self._table is not None:
            self._keyframe[np.isin(self._table.ids, ids)] = _FREE

    def nearby(self, state: FilterState, camera: Camera) -> DormantTable | None:
        """Return features that the camera should see, of the nearest keyframes first; None without any.

        `anchor` is the index in the state.
        """
        (distance,), (angle,) = se3.pairwise_distances(state.T[None], state.keyframe_poses)
        is_near = (distance < _MAX_DISTANCE_M) & (angle < _MAX_ANGLE_RAD)
        nearest = np.argsort(distance + angle, kind="stable")
        nearest = nearest[is_near[nearest]]
        rows, rank = np.nonzero(self._keyframe[:, None] == state.keyframe_ids[nearest])
        if self._table is None or not len(rows):
            return None
        order = np.lexsort((self._number[rows], rank))
        rows, rank = rows[order], rank[order]
        ray, rho = self._table.ray[rows], self._table.rho[rows]
        in_view = feature_matching.is_in_view(state, camera, nearest[rank], ray, rho)
        rows, rank = rows[in_view], rank[in_view]
        if not len(rows):
            return None
        # Keyframes that come when there are enough already are left out.
        is_searched = rank <= rank[min(_MAX_SEARCHED, len(rank)) - 1]
        return replace(self._table.take(rows[is_searched]), anchor=nearest[rank[is_searched]])


def nis(state: FilterState, rows: filter.FeatureMeasurements, rho_sigma: F64) -> F64:
    """Return the NIS (M,) of measurements of dormant features, which the state does not have: their inverse
    depths err by rho_sigma (M,) 1/m, independently."""
    M = len(rows.feature)
    columns = np.empty((M, CORE_SIZE + 6), np.int64)
    columns[:, :CORE_SIZE] = np.arange(CORE_SIZE)
    columns[:, CORE_SIZE:] = KEYFRAMES_START + 6 * rows.anchor[:, None] + np.arange(6)
    H = np.concatenate([rows.H_core, rows.H_anchor], axis=2)
    S = H @ state.cov[columns[:, :, None], columns[:, None, :]] @ H.swapaxes(1, 2)
    S += rows.H_rho[:, :, None] * rows.H_rho[:, None, :] * (rho_sigma**2)[:, None, None]
    S += (rows.sigma**2 + rows.correlated_sigma**2)[:, None, None] * np.eye(2)
    return filter.residual_nis(rows.residual, S[:, 0, 0], S[:, 0, 1], S[:, 1, 1])
