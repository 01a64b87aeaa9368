"""The localisation gate: an agent enters another map once its pose there is certain enough.

A merge by a few loops at one spot can be wrong by degrees, which further loops correct within seconds; until
then the agent keeps its own map. Agents that shared a map enter the new one together. The gate judges the
position of what a wearer looks at (`sigma_ahead`), so a rotation counts by its lever. The more keyframes have
loops, the less each further one improves the pose, so the gate allows a larger sigma. After `PATIENCE` of
them it opens to all: in a large hall, far from the reference, no pose is known to centimetres.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.types import F64

PATIENCE = 20  # keyframes with loops after which agents enter another map however uncertain
_WIDENS_AFTER = 8  # keyframes with loops; with n times as many, n times the sigma is enough
ROBOT_SHARE = 0.4  # of the sigma that is enough for a wearer: a robot's odometry is surer, and can wait
AHEAD_M = 3.0  # what a wearer or robot looks at; a rotation moves it by this lever


def sigma_ahead(cov: F64) -> float:
    """Return the standard deviation (m) of what is 3 m from a body whose pose has the covariance (6, 6)."""
    return float(np.hypot(se3.position_sigma(cov), AHEAD_M * se3.rotation_sigma(cov)))


def body_motion(T_old: F64, T_new: F64, T_odom_body: F64) -> F64:
    """Return the motion (6,) of the body from one T_map_odom to another, on the right."""
    return se3.log(se3.inverse(T_old @ T_odom_body) @ T_new @ T_odom_body)


def length_ahead(xi: F64) -> float:
    """Return how far (m) a motion (6,) of the body moves it and what is 3 m ahead of it, at most."""
    return float(np.linalg.norm(xi[3:]) + AHEAD_M * np.linalg.norm(xi[:3]))


@dataclass(frozen=True, eq=False)
class PlacementUncertainty:
    """Uncertainty of an agent's pose in a map.

    cov (6, 6): of T_map_odom. sigma_m: `sigma_ahead` of the body's pose. answered_id: the agent's keyframe
    with a loop that is new in this solution, or None. is_worn: by somebody who waits to share the map.
    """

    cov: F64
    sigma_m: float
    answered_id: int | None = None
    is_worn: bool = True


class LocalisationGate:
    """State of the gate for each segment. Segments and reference segments are given by their indices."""

    def __init__(self, enter_m: float) -> None:
        """enter_m: sigma at which wearers enter another map, at the latest after `PATIENCE` keyframes; robots
        at a smaller one."""
        self._enter_m = enter_m
        # By segment: reference segment of the published map, and the covariance there.
        self._published: dict[int, tuple[int, F64 | None]] = {}
        # By map left and map entered: (segment, keyframe) with loops since the merge.
        self._waited: dict[tuple[int, int], set[tuple[int, int]]] = {}

    def restore(self, segment: int, reference_segment: int) -> None:
        """An earlier session published this map to the segment; its covariance there is not known yet."""
        self._published[segment] = (reference_segment, None)

    def forget_all_but(self, segments: Collection[int]) -> None:
        """Forget all but these segments: the others have no keyframes."""
        self._published = {s: known for s, known in self._published.items() if s in segments}

    def is_published(self, segment: int, reference_segment: int) -> bool:
        """Return whether the segment's agent was sent a correction in this map."""
        return segment in self._published and self._published[segment][0] == reference_segment

    def published_cov(self, segment: int, reference_segment: int) -> F64 | None:
        """Last covariance (6, 6) of T_map_odom; None if unknown or if the map is not published."""
        published, cov = self._published.get(segment, (None, None))
        return cov if published == reference_segment else None

    def forget_waits(self, segments: Collection[int]) -> None:
        """Restart the wait of these segments, whose merge was undone."""
        self._waited = {pair: waited for pair, waited in self._waited.items() if pair[0] not in segments}

    def update(
        self,
        reference_segment: int,
        map_segments: Collection[int],
        uncertainties: Mapping[int, PlacementUncertainty],
    ) -> dict[int, float]:
        """Apply a solution of a map: publish it to the segments that may enter.

        Returns the sigma (m) of each segment that has to wait.
        """
        entering: dict[int, list[int]] = {}
        for s in uncertainties:
            previous_map = self._published[s][0] if s in self._published else s
            enters = reference_segment not in (s, previous_map)
            if enters and previous_map in map_segments:  # else the published map no longer exists
                entering.setdefault(previous_map, []).append(s)
        waiting_groups = (
            group
            for previous_map, group in entering.items()
            if self._must_wait(previous_map, reference_segment, uncertainties, group)
        )
        waiting = [s for group in waiting_groups for s in group]
        self._published |= {
            s: (reference_segment, known.cov) for s, known in uncertainties.items() if s not in waiting
        }
        return {s: uncertainties[s].sigma_m for s in waiting}

    def _must_wait(
        self,
        previous_map: int,
        reference_segment: int,
        uncertainties: Mapping[int, PlacementUncertainty],
        entering: list[int],
    ) -> bool:
        """Decide for the segments that enter from one map, and count their keyframes with loops."""
        waited = self._waited.setdefault((previous_map, reference_segment), set())
        waited.update((s, key) for s in entering if (key := uncertainties[s].answered_id) is not None)
        enough_m = self._enter_m * max(1.0, len(waited) / _WIDENS_AFTER)
        if not any(uncertainties[s].is_worn for s in entering):
            enough_m *= ROBOT_SHARE
        return max(uncertainties[s].sigma_m for s in entering) > enough_m and len(waited) <= PATIENCE
