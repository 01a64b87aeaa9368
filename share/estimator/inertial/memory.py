"""Features that are out of sight, kept with the keyframes that saw them first until these are seen again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from share.columns import Columns
from share.estimator.inertial.features import Looks
from share.estimator.inertial.state import State
from share.geometry import se3
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
        self._of: dict[int, Asleep] = {}

    def sleep(self, state: State, looks: Looks, which: I64) -> None:
        """Remember features number `which` of the state if their depth is known."""
        sigma = _FORGETFUL * np.sqrt(state.rho_variance[which])
        known = (sigma < _KNOWN * np.abs(state.rho[which])) | (sigma < 0.003)
        known &= looks.age[which] >= 5
        for host in np.unique(state.host[which[known]]):
            mine = known & (state.host[which] == host)
            part = which[mine]
            asleep = Asleep(
                state.ids[part],
                state.host[part],
                state.ray[part],
                state.rho[part],
                sigma[mine],
                looks.take(part),
            )
            key = int(state.keyframes[host])
            old = self._of.get(key)
            asleep = asleep if old is None else old.join(asleep)
            best = np.argsort(asleep.sigma, kind="stable")[:_MOST]
            self._of[key] = asleep.take(np.sort(best))

    def has(self, keyframe: int) -> bool:
        return keyframe in self._of

    def forget(self, keyframes: I64) -> None:
        for keyframe in keyframes.tolist():
            self._of.pop(keyframe, None)

    def near(self, state: State, max_m: float, max_rad: float, most: int) -> Asleep | None:
        """Those of the keyframes that look from about here, the nearest ones first until there are `most`;
        their hosts are numbers in the state. None where there are none."""
        (far,), (turned,) = se3.apart(state.T[None], state.poses)
        out: Asleep | None = None
        for k in np.argsort(far + turned, kind="stable").tolist():
            mine = self._of.get(int(state.keyframes[k]))
            if mine is None or far[k] >= max_m or turned[k] >= max_rad:
                continue
            mine = replace(mine, host=np.full(len(mine.ids), k))
            out = mine if out is None else out.join(mine)
            if len(out.ids) >= most:
                break
        return out

    def wake(self, ids: I64) -> None:
        """These are features of the state again."""
        for keyframe, asleep in list(self._of.items()):
            keep = ~np.isin(asleep.ids, ids)
            if not keep.any():
                del self._of[keyframe]
            elif not keep.all():
                self._of[keyframe] = asleep.take(keep)
