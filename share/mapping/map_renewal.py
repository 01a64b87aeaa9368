"""Renewal of a map from an earlier session: keyframes that show what is gone are removed, once views of today
can replace them.

A keyframe of an earlier session is removed when views of today from its place show most of what it shows, but
several of them miss whole regions of it. Different light alone hides single points, not a region amid others
that are found. Where no view of today is from its place a keyframe stays, so no map is emptied.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.mapping.loop_consistency import PLACE_M, PLACE_RAD
from share.mapping.map_graph import MapGraph
from share.mapping.missing_points import vanished_regions
from share.mapping.overlap_check import OTHER_DAY, SAME_DAY, OverlapCheck
from share.mapping.recognition.verification import CameraView

_OUTDATED_CUSUM = 0.2  # CUSUM of the missing share of a keyframe above that of one day; beyond, it goes
_MIN_VIEWS = 2  # of today that miss something
_MAX_COMPARED = 3  # keyframes of earlier sessions, with each of today


@dataclass
class _Loss:
    """What views of today miss of a keyframe: CUSUM of the missing share, and how many views miss any."""

    missing: float = 0.0
    view_count: int = 0


class MapRenewal:
    """Finds keyframes of earlier sessions whose scene has changed."""

    def __init__(
        self, graph: MapGraph, camera_views: Mapping[int, CameraView], overlap_check: OverlapCheck
    ) -> None:
        self._graph, self._camera_views, self._overlap_check = graph, camera_views, overlap_check
        self._losses: dict[int, _Loss] = {}
        self._outdated: dict[int, None] = {}

    def review(self, node_id: int) -> None:
        """Compare a view of today with those of earlier sessions at its place, unless a merge of its segment
        is on probation."""
        for earlier in self._earlier_keyframes_near(node_id):
            self._compare(node_id, earlier)

    def _compare(self, node_id: int, earlier: int) -> None:
        T_new_old = self._graph.relative_pose(node_id, earlier)
        seen = vanished_regions(self._camera_views[earlier], self._camera_views[node_id], T_new_old)
        if not seen.is_informative or seen.found_share < OTHER_DAY.found:
            return  # too few of its points are found: darkness, blur
        loss = self._losses.setdefault(earlier, _Loss())
        excess = seen.missing_share - SAME_DAY.missing
        loss.missing, loss.view_count = max(0.0, loss.missing + excess), loss.view_count + (excess > 0)
        if loss.missing > _OUTDATED_CUSUM and loss.view_count >= _MIN_VIEWS:
            self._outdated[earlier] = None

    def take_outdated(self) -> list[int]:
        """Return the keyframes to remove since the last call."""
        outdated, self._outdated = list(self._outdated), {}
        for node_id in outdated:
            self._losses.pop(node_id, None)
        return [node_id for node_id in outdated if node_id in self._graph.poses]

    def _earlier_keyframes_near(self, node_id: int) -> list[int]:
        """Return the nearest keyframes of earlier sessions that this one can replace."""
        graph, is_earlier = self._graph, self._overlap_check.is_earlier
        if is_earlier(node_id) or self._overlap_check.is_on_probation(graph.odometry.nodes[node_id].segment):
            return []
        near_ids, poses = graph.near(node_id, PLACE_M)
        near = [i for i, n in enumerate(near_ids.tolist()) if is_earlier(n) and n in self._camera_views]
        if not near:
            return []
        (distance,), (angle,) = se3.pairwise_distances(graph.poses[node_id][None], poses[near])
        unlike = distance / PLACE_M + angle / PLACE_RAD  # as in `share.mapping.redundancy`
        nearest = np.argsort(unlike, kind="stable")[:_MAX_COMPARED]
        return [int(near_ids[near[i]]) for i in nearest if unlike[i] < 1]
