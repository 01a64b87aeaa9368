"""How surely the map knows where each agent's odometry lies in it, and whether he hears of it.

Who comes into another's map is not told where he is there while that is known badly. A join by a few loops at
one spot can be turned by degrees, which further loops put right within seconds; until then his own map
goes on. Those who were in one map together hear of the new one together. Nobody waits for more than so many
keyframes with loops: in a large hall, far from where its map began, nothing is known to a few centimetres.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.types import F64, Correction

# ---- Which corrections an agent has to be told: those that move it, or that it waits for.

_LEAST_M, _LEAST_RAD = 1e-3, float(np.radians(0.02))  # what moves an agent less, it does not notice


class Concern:
    """What every agent was told last. `agent` names one run of an agent."""

    def __init__(self) -> None:
        self._told: dict[str, Correction] = {}

    def forget(self, agent: str) -> None:
        self._told.pop(agent, None)

    def concerns(self, agent: str, correction: Correction) -> bool:
        """Whether it has to be sent; if so, it counts as told. It answers a keyframe, names another map, or
        moves odom by more than a millimetre or 0.02 degrees."""
        told = self._told.get(agent)
        if told is not None and not _is_news(told, correction):
            return False
        self._told[agent] = correction
        return True


def _is_news(told: Correction, new: Correction) -> bool:
    if new.answers >= 0 or new.map_id != told.map_id:
        return True
    moved = se3.inverse(told.T_map_odom) @ new.T_map_odom
    return bool(np.linalg.norm(moved[:3, 3]) > _LEAST_M or se3.angle(moved) > _LEAST_RAD)


@dataclass(frozen=True, eq=False)
class Found:
    """cov (6, 6): of T_map_odom. spread_m: 1 sigma (root of the trace) of where the agent is. answers: his
    keyframe from which a loop is new in this solution, None if there is none."""

    cov: F64
    spread_m: float
    answers: int | None = None


class Surety:
    """Of stretches, by their numbers; maps by their founders'."""

    def __init__(self, enter_m: float, patience: int) -> None:
        """enter_m: who is known worse waits before another map, for at most so many keyframes with loops."""
        self._enter_m, self._patience = enter_m, patience
        self._told: dict[int, tuple[int, F64 | None]] = {}  # founder of the map he was told of, cov there
        self._waited: dict[tuple[int, int], set[tuple[int, int]]] = {}  # keyframes, by map left and entered

    def remember(self, stretch: int, founder: int) -> None:
        """An earlier life has told him of this map; how surely he is known there is yet to be found."""
        self._told[stretch] = (founder, None)

    def forget(self, stretches: Collection[int]) -> None:
        """These have no keyframes any more."""
        for stretch in stretches:
            self._told.pop(stretch, None)

    def heard(self, stretch: int, founder: int) -> bool:
        """Whether he has heard of this map."""
        return stretch in self._told and self._told[stretch][0] == founder

    def told(self, stretch: int, founder: int) -> F64 | None:
        """cov (6, 6) of T_map_odom, as last found; None if it was not, or he has not heard of this map."""
        known, cov = self._told.get(stretch, (None, None))
        return cov if known == founder else None

    def parted(self, stretches: Collection[int]) -> None:
        """A join that took these in was undone: if it is made again, it is waited for anew."""
        self._waited = {pair: who for pair, who in self._waited.items() if pair[0] not in stretches}

    def take(self, founder: int, parts: Collection[int], found: Mapping[int, Found]) -> dict[int, float]:
        """What a solution of a map, of these stretches, says of those whom it was asked for. Returns who
        waits: his spread, m."""
        entering: dict[int, list[int]] = {}
        for s in found:
            before = self._told[s][0] if s in self._told else s
            if s != founder and before != founder and before in parts:  # else the map that he knows is none
                entering.setdefault(before, []).append(s)
        wait = (who for before, who in entering.items() if self._waits(before, founder, found, who))
        waiting = [s for who in wait for s in who]
        self._told |= {s: (founder, at.cov) for s, at in found.items() if s not in waiting}
        return {s: found[s].spread_m for s in waiting}

    def _waits(self, before: int, founder: int, found: Mapping[int, Found], who: list[int]) -> bool:
        """Those who come from one map; counted."""
        if max(found[s].spread_m for s in who) <= self._enter_m:
            return False
        waited = self._waited.setdefault((before, founder), set())
        waited.update((s, key) for s in who if (key := found[s].answers) is not None)
        return len(waited) <= self._patience
