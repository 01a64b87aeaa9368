"""Features that are out of sight, kept with the keyframes that saw them first until these are seen again."""

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

_MAX_RELATIVE_SIGMA = 0.1  # relative sigma of an inverse depth worth remembering
_SIGMA_INFLATION = 1.5  # times the sigma that it had: what it shared with the pose is lost
_MAX_PER_KEYFRAME = 40  # of a keyframe


@dataclass(frozen=True, eq=False)
class DormantTable(ArrayTable):
    """Features: ids (N,), number of the host (N,), rays (N, 2), inverse depths and sigmas (N,), looks."""

    ids: I64
    anchor: I64
    ray: F64
    rho: F64
    sigma: F64
    appearance: Appearance


class DormantFeatures:
    """By keyframe id. Memory is bounded by the keyframes of the state."""

    def __init__(self) -> None:
        self._by_keyframe: dict[int, list[DormantTable]] = {}  # in the order in which they fell asleep
        self._unsorted: list[
            tuple[I64, DormantTable]
        ] = []  # ids of their hosts; sorted only where somebody asks

    def deactivate(self, state: FilterState, appearance: Appearance, indices: I64) -> None:
        """Remember features number `indices` of the state if their depth is known."""
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
        """By keyframe."""
        if not self._unsorted:
            return
        keys = np.concatenate([keys for keys, _ in self._unsorted])
        first, *others = (dormant for _, dormant in self._unsorted)
        new, self._unsorted = first.concatenate(*others), []
        for key in np.unique(keys).tolist():
            self._by_keyframe.setdefault(key, []).append(new.take(keys == key))

    def _most_certain(self, keyframe: int) -> DormantTable | None:
        """Of one keyframe."""
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
        """Of which keyframes (K,) there are any."""
        self._group_by_keyframe()
        return np.isin(keyframe_ids, list(self._by_keyframe))

    def drop_keyframes(self, keyframe_ids: I64) -> None:
        self._group_by_keyframe()
        for keyframe_id in keyframe_ids.tolist():
            self._by_keyframe.pop(keyframe_id, None)

    def nearby(
        self, state: FilterState, camera: Camera, max_m: float, max_rad: float, max_count: int
    ) -> DormantTable | None:
        """Those that the camera should see of the keyframes that look from about here, the nearest ones first
        until there are `max_count`; their hosts are numbers in the state. None where there are none."""
        self._group_by_keyframe()
        (distance,), (angle,) = se3.pairwise_distances(state.T[None], state.keyframe_poses)
        out: list[DormantTable] = []
        for k in np.argsort(distance + angle, kind="stable").tolist():
            if distance[k] >= max_m or angle[k] >= max_rad:
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
            if sum(len(table.ids) for table in out) >= max_count:
                break
        return out[0].concatenate(*out[1:]) if out else None

    def reactivate(self, ids: I64) -> None:
        """These are features of the state again."""
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
