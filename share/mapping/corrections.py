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

_MIN_SHIFT_M, _MIN_ROTATION_RAD = (
    1e-3,
    float(np.radians(0.02)),
)  # what moves an agent less, it does not notice


class CorrectionFilter:
    """What every agent was told last. `agent` names one run of an agent."""

    def __init__(self) -> None:
        self._last_sent: dict[str, Correction] = {}

    def remove_agent(self, agent: str) -> None:
        self._last_sent.pop(agent, None)

    def should_send(self, agent: str, correction: Correction) -> bool:
        """Whether it has to be sent; if so, it counts as told. It answers a keyframe, names another map, or
        moves odom by more than a millimetre or 0.02 degrees."""
        last_sent = self._last_sent.get(agent)
        if last_sent is not None and not _has_changed(last_sent, correction):
            return False
        self._last_sent[agent] = correction
        return True


def _has_changed(last_sent: Correction, new: Correction) -> bool:
    if new.answered_keyframe >= 0 or new.map_id != last_sent.map_id:
        return True
    moved = se3.inverse(last_sent.T_map_odom) @ new.T_map_odom
    return bool(np.linalg.norm(moved[:3, 3]) > _MIN_SHIFT_M or se3.rotation_angle(moved) > _MIN_ROTATION_RAD)


@dataclass(frozen=True, eq=False)
class PlacementUncertainty:
    """cov (6, 6): of T_map_odom. spread_m: 1 sigma (root of the trace) of where the agent is. answers: his
    keyframe from which a loop is new in this solution, None if there is none."""

    cov: F64
    sigma_m: float
    answered_id: int | None = None


class LocalisationGate:
    """Of stretches, by their numbers; maps by their founders'."""

    def __init__(self, enter_m: float, patience: int) -> None:
        """enter_m: who is known worse waits before another map, for at most so many keyframes with loops."""
        self._enter_m, self._patience = enter_m, patience
        self._published: dict[
            int, tuple[int, F64 | None]
        ] = {}  # founder of the map he was told of, cov there
        self._waited_for: dict[
            tuple[int, int], set[tuple[int, int]]
        ] = {}  # keyframes, by map left and entered

    def restore(self, segment: int, reference_segment: int) -> None:
        """An earlier life has told him of this map; how surely he is known there is yet to be found."""
        self._published[segment] = (reference_segment, None)

    def forget(self, segments: Collection[int]) -> None:
        """These have no keyframes any more."""
        for segment in segments:
            self._published.pop(segment, None)

    def is_published(self, segment: int, reference_segment: int) -> bool:
        """Whether he has heard of this map."""
        return segment in self._published and self._published[segment][0] == reference_segment

    def published_cov(self, segment: int, reference_segment: int) -> F64 | None:
        """cov (6, 6) of T_map_odom, as last found; None if it was not, or he has not heard of this map."""
        known, cov = self._published.get(segment, (None, None))
        return cov if known == reference_segment else None

    def forget_waits(self, segments: Collection[int]) -> None:
        """A join that took these in was undone: if it is made again, it is waited for anew."""
        self._waited_for = {
            pair: waited_for for pair, waited_for in self._waited_for.items() if pair[0] not in segments
        }

    def update(
        self,
        reference_segment: int,
        map_segments: Collection[int],
        uncertainties: Mapping[int, PlacementUncertainty],
    ) -> dict[int, float]:
        """What a solution of a map, of these stretches, says of those whom it was asked for. Returns who
        waits: his spread, m."""
        entering: dict[int, list[int]] = {}
        for s in uncertainties:
            previous_map = self._published[s][0] if s in self._published else s
            if (
                s != reference_segment and previous_map != reference_segment and previous_map in map_segments
            ):  # else the map that he knows is none
                entering.setdefault(previous_map, []).append(s)
        waiting_groups = (
            group
            for previous_map, group in entering.items()
            if self._must_wait(previous_map, reference_segment, uncertainties, group)
        )
        waiting = [s for group in waiting_groups for s in group]
        self._published |= {
            s: (reference_segment, at.cov) for s, at in uncertainties.items() if s not in waiting
        }
        return {s: uncertainties[s].sigma_m for s in waiting}

    def _must_wait(
        self,
        previous_map: int,
        reference_segment: int,
        uncertainties: Mapping[int, PlacementUncertainty],
        entering: list[int],
    ) -> bool:
        """Those who come from one map; counted."""
        if max(uncertainties[s].sigma_m for s in entering) <= self._enter_m:
            return False
        waited = self._waited_for.setdefault((previous_map, reference_segment), set())
        waited.update((s, key) for s in entering if (key := uncertainties[s].answered_id) is not None)
        return len(waited) <= self._patience
