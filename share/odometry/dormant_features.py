"""Features that are out of sight, kept with the keyframes that saw them first until these are seen again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from share.columns import Columns
from share.geometry import se3
from share.geometry.camera import Camera
from share.odometry import measurement
from share.odometry.features import Looks
from share.odometry.state import State
from share.types import F64, I64

_KNOWN = 0.1  # relative sigma of an inverse depth worth remembering
_FORGETFUL = 1.5  # times the sigma that it had: what it shared with the pose is lost
_MOST = 40  # of a keyframe


@dataclass(frozen=True, eq=False)
class Asleep(Columns):
    """Features: ids (N,), number of the host (N,), rays (N, 2), inverse depths and sigmas (N,), looks."""

    ids: I64
    host: I64
    ray: F64
    rho: F64
    sigma: F64
    looks: Looks


class Memory:
    """By keyframe id. Memory is bounded by the keyframes of the state."""

    def __init__(self) -> None:
        self._of: dict[int, list[Asleep]] = {}  # in the order in which they fell asleep
        self._new: list[tuple[I64, Asleep]] = []  # ids of their hosts; sorted only where somebody asks

    def sleep(self, state: State, looks: Looks, which: I64) -> None:
        """Remember features number `which` of the state if their depth is known."""
        sigma = _FORGETFUL * np.sqrt(state.rho_variance[which])
        known = (sigma < _KNOWN * np.abs(state.rho[which])) | (sigma < 0.003)
        known &= looks.age[which] >= 5
        part = which[known]
        if len(part):
            hosts, looked = state.host[part], looks.take(part)
            asleep = Asleep(state.ids[part], hosts, state.ray[part], state.rho[part], sigma[known], looked)
            self._new.append((state.keyframes[hosts], asleep))

    def _sort(self) -> None:
        """By keyframe."""
        if not self._new:
            return
        keys = np.concatenate([keys for keys, _ in self._new])
        first, *others = (asleep for _, asleep in self._new)
        new, self._new = first.join(*others), []
        for key in np.unique(keys).tolist():
            self._of.setdefault(key, []).append(new.take(keys == key))

    def _best(self, keyframe: int) -> Asleep | None:
        """Of one keyframe."""
        if keyframe not in self._of:
            return None
        first, *others = self._of[keyframe]
        asleep = first.join(*others) if others else first
        if len(asleep.ids) > _MOST:
            best = np.argsort(asleep.sigma, kind="stable")[:_MOST]
            asleep = asleep.take(np.sort(best))
        self._of[keyframe] = [asleep]
        return asleep

    def has(self, keyframes: I64) -> NDArray[np.bool_]:
        """Of which keyframes (K,) there are any."""
        self._sort()
        return np.isin(keyframes, list(self._of))

    def forget(self, keyframes: I64) -> None:
        self._sort()
        for keyframe in keyframes.tolist():
            self._of.pop(keyframe, None)

    def near(self, state: State, camera: Camera, max_m: float, max_rad: float, most: int) -> Asleep | None:
        """Those that the camera should see of the keyframes that look from about here, the nearest ones first
        until there are `most`; their hosts are numbers in the state. None where there are none."""
        self._sort()
        (far,), (turned,) = se3.apart(state.T[None], state.poses)
        out: list[Asleep] = []
        for k in np.argsort(far + turned, kind="stable").tolist():
            if far[k] >= max_m or turned[k] >= max_rad:
                continue
            mine = self._best(int(state.keyframes[k]))
            if mine is None:
                continue
            mine = mine.take(measurement.in_view(state, camera, k, mine.ray, mine.rho))
            if len(mine.ids) == 0:
                continue
            out.append(replace(mine, host=np.full(len(mine.ids), k)))
            if sum(len(one.ids) for one in out) >= most:
                break
        return out[0].join(*out[1:]) if out else None

    def wake(self, ids: I64) -> None:
        """These are features of the state again."""
        self._sort()
        gone = set(ids.tolist())
        for keyframe, parts in list(self._of.items()):
            left = [_without(part, gone) for part in parts]
            self._of[keyframe] = [part for part in left if len(part.ids)]
            if not self._of[keyframe]:
                del self._of[keyframe]


def _without(asleep: Asleep, ids: set[int]) -> Asleep:
    keep = [n for n, feature in enumerate(asleep.ids.tolist()) if feature not in ids]
    return asleep if len(keep) == len(asleep.ids) else asleep.take(np.array(keep, np.int64))
