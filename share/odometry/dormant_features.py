"""Dormant features: features out of view, kept with their anchor keyframes until they are in view again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from share.array_table import ArrayTable
from share.geometry import se3
from share.geometry.camera import Camera
from share.odometry import feature_matching
from share.odometry.feature_appearance import Appearance
from share.odometry.state import FilterState
from share.types import F64, I64

_MAX_RELATIVE_SIGMA = 0.1  # relative sigma of an inverse depth that is kept
_SIGMA_INFLATION = 1.5  # times its sigma, because its correlation with the poses is lost
_MAX_PER_KEYFRAME = 40  # features
_MAX_SEARCHED = 80  # that a keyframe searches for again,
_MAX_DISTANCE_M, _MAX_ANGLE_RAD = 1.5, 0.7  # of keyframes at most so far away


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
    """Dormant features by the id of their anchor keyframe. Memory is bounded by the number of keyframes in
    the state."""

    def __init__(self) -> None:
        self._by_keyframe: dict[int, list[DormantTable]] = {}  # oldest first
        # Anchor ids and features, grouped by keyframe only when needed.
        self._unsorted: list[tuple[I64, DormantTable]] = []

    def deactivate(self, state: FilterState, appearance: Appearance, indices: I64) -> None:
        """Keep features `indices` of the state if their depth is well known."""
        sigma = _SIGMA_INFLATION * np.sqrt(state.rho_variance[indices])
        is_known = (sigma < _MAX_RELATIVE_SIGMA * np.abs(state.rho[indices])) | (sigma < 0.003)
        is_known &= appearance.age[indices] >= 5
        indices_kept = indices[is_known]
        if len(indices_kept):
            anchors, appearance_kept = state.anchor[indices_kept], appearance.take(indices_kept)
            dormant = DormantTable(
                state.feature_ids[indices_kept],
                anchors,
                state.ray[indices_kept],
                state.rho[indices_kept],
                sigma[is_known],
                appearance_kept,
            )
            self._unsorted.append((state.keyframe_ids[anchors], dormant))

    def _group_by_keyframe(self) -> None:
        """Move `_unsorted` into `_by_keyframe`."""
        if not self._unsorted:
            return
        keys = np.concatenate([keys for keys, _ in self._unsorted])
        first, *others = (dormant for _, dormant in self._unsorted)
        new, self._unsorted = first.concatenate(*others), []
        for key in np.unique(keys).tolist():
            self._by_keyframe.setdefault(key, []).append(new.take(keys == key))

    def _most_certain(self, keyframe: int) -> DormantTable | None:
        """Return the dormant features of one keyframe, reduced to the most certain ones; None without any."""
        if keyframe not in self._by_keyframe:
            return None
        first, *others = self._by_keyframe[keyframe]
        dormant = first.concatenate(*others) if others else first
        if len(dormant.ids) > _MAX_PER_KEYFRAME:
            best = np.argsort(dormant.sigma, kind="stable")[:_MAX_PER_KEYFRAME]
            dormant = dormant.take(np.sort(best))
        self._by_keyframe[keyframe] = [dormant]
        return dormant

    def has_features(self, keyframe_ids: I64) -> NDArray[np.bool_]:
        """Return which keyframes (K,) have dormant features."""
        self._group_by_keyframe()
        return np.isin(keyframe_ids, list(self._by_keyframe))

    def drop_keyframes(self, keyframe_ids: I64) -> None:
        """Forget the features of these keyframes."""
        self._group_by_keyframe()
        for keyframe_id in keyframe_ids.tolist():
            self._by_keyframe.pop(keyframe_id, None)

    def nearby(self, state: FilterState, camera: Camera) -> DormantTable | None:
        """Return features that the camera should see, of the nearest keyframes first; None without any.

        `anchor` is the index in the state.
        """
        self._group_by_keyframe()
        (distance,), (angle,) = se3.pairwise_distances(state.T[None], state.keyframe_poses)
        out: list[DormantTable] = []
        for k in np.argsort(distance + angle, kind="stable").tolist():
            if distance[k] >= _MAX_DISTANCE_M or angle[k] >= _MAX_ANGLE_RAD:
                continue
            candidates = self._most_certain(int(state.keyframe_ids[k]))
            if candidates is None:
                continue
            candidates = candidates.take(
                feature_matching.is_in_view(state, camera, k, candidates.ray, candidates.rho)
            )
            if len(candidates.ids) == 0:
                continue
            out.append(replace(candidates, anchor=np.full(len(candidates.ids), k)))
            if sum(len(table.ids) for table in out) >= _MAX_SEARCHED:
                break
        return out[0].concatenate(*out[1:]) if out else None

    def reactivate(self, ids: I64) -> None:
        """Remove the features with these ids: they are in the state again."""
        self._group_by_keyframe()
        reactivated = set(ids.tolist())
        for keyframe, parts in list(self._by_keyframe.items()):
            remaining = [_without_ids(part, reactivated) for part in parts]
            self._by_keyframe[keyframe] = [part for part in remaining if len(part.ids)]
            if not self._by_keyframe[keyframe]:
                del self._by_keyframe[keyframe]


def _without_ids(dormant: DormantTable, ids: set[int]) -> DormantTable:
    keep = [n for n, feature in enumerate(dormant.ids.tolist()) if feature not in ids]
    return dormant if len(keep) == len(dormant.ids) else dormant.take(np.array(keep, np.int64))
