"""Which keyframes a keyframe is compared with, and how.

There are two sources: keyframes near it by the map's poses, and keyframes that a query finds by appearance.
Within a map most of what looks alike is out of view and is left out. What is in view is aligned from the
map's pose, which costs a third of a verification and succeeds more often. Everything else is verified.
Because the map may be wrong, the candidates of some keyframes are verified whatever the map says
(`is_recheck`).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet
from typing import NamedTuple

import numpy as np

from share.geometry import se3
from share.mapping.map_graph import MapGraph

# Views further apart than either seldom share enough points.
_FAR_M = 4.0
_FAR_RAD = 1.0
_SURE_SIGMAS = 3.0  # by which they are further apart
# Images align from a pose of the map that is known at least so well. The covariances are upper bounds: the
# poses are about three times as good.
_ALIGN_SIGMA_M = 0.1
_ALIGN_SIGMA_RAD = float(np.radians(1.0))


class CandidateChecks(NamedTuple):
    """Candidates of one query, best first. by_map: to be aligned; by_appearance: to be verified."""

    by_map: list[int]
    by_appearance: list[int]


def choose_checks(
    graph: MapGraph,
    node_id: int,
    candidates: Sequence[int],
    with_image: AbstractSet[int],
    is_aligned: bool,
    is_recheck: bool,
) -> CandidateChecks:
    """Choose how to check each candidate of a keyframe.

    is_aligned: the keyframe was aligned with others near it, so the map is right around it, and those near it
    are left out. is_recheck: verify what is out of view by the map too, and all others that are not aligned.
    """
    own = [n for n in candidates if graph.is_same_map(node_id, n)]
    out_of_view, alignable = _by_map_poses(graph, node_id, own)
    left_out = set(own) - out_of_view if is_aligned else set[int]()
    if is_recheck:
        return CandidateChecks([], [n for n in candidates if n not in left_out])
    left_out |= out_of_view
    by_map = [n for n in own if n in alignable - left_out and {n, node_id} <= with_image]
    return CandidateChecks(by_map, [n for n in candidates if n not in left_out and n not in by_map])


def _by_map_poses(graph: MapGraph, node_id: int, own: Sequence[int]) -> tuple[set[int], set[int]]:
    """Return which keyframes of the map are surely out of view, and which others have a pose that is known
    well enough to align."""
    out_of_view, alignable = set[int](), set[int]()
    if not own:
        return out_of_view, alignable
    for other, pose in zip(own, graph.relative_estimates(node_id, own), strict=True):
        sigma_m, sigma_rad = se3.position_sigma(pose.cov), se3.rotation_sigma(pose.cov)
        distance_m, angle_rad = float(np.linalg.norm(pose.T[:3, 3])), float(se3.rotation_angle(pose.T))
        if distance_m - _SURE_SIGMAS * sigma_m > _FAR_M or angle_rad - _SURE_SIGMAS * sigma_rad > _FAR_RAD:
            out_of_view.add(other)
        elif sigma_m <= _ALIGN_SIGMA_M and sigma_rad <= _ALIGN_SIGMA_RAD:
            alignable.add(other)
    return out_of_view, alignable


def larger_maps_first(graph: MapGraph, others: Sequence[int]) -> list[int]:
    """Sort candidates: those in larger maps first, so that agents end up in one map."""
    maps = {n: graph.reference_segments[graph.odometry.nodes[n].segment] for n in others}
    sizes = {reference_segment: graph.map_size(reference_segment) for reference_segment in set(maps.values())}
    return sorted(others, key=lambda n: -sizes[maps[n]])


# ---- Keyframes near one by the map's poses

_NEAR_M, _NEAR_RAD = 1.8, 0.7  # between bodies; beyond either, few patches align
_MAX_CANDIDATES = 3
_MAX_PER_SEGMENT = 2  # so that loops with other agents come too


def nearby_candidates(graph: MapGraph, node_id: int, eligible: AbstractSet[int]) -> list[int]:
    """Return the keyframes of the map, of those eligible, that see most of what this one sees, best first;
    without its neighbours by odometry."""
    excluded = {node_id, *graph.odometry.neighbours(node_id)}
    chosen: list[int] = []
    per_segment = Counter[int]()
    for near_id in _nearest_first(graph, node_id):
        segment = graph.odometry.nodes[near_id].segment
        if near_id in excluded or near_id not in eligible:
            continue
        if per_segment[segment] < _MAX_PER_SEGMENT:
            per_segment[segment] += 1
            chosen.append(near_id)
        if len(chosen) == _MAX_CANDIDATES:
            break
    return chosen


def _nearest_first(graph: MapGraph, node_id: int) -> list[int]:
    """Return the nodes of its map within the limits, those that see most of what this one sees first."""
    node_ids, poses = graph.near(node_id, _NEAR_M)
    (distance,), (angle,) = se3.pairwise_distances(graph.poses[node_id][None], poses)
    cost = np.where(angle < _NEAR_RAD, distance / _NEAR_M + angle / _NEAR_RAD, np.inf)
    order = np.argsort(cost, kind="stable")[: np.isfinite(cost).sum()]
    return [int(n) for n in node_ids[order]]


# ---- How many candidates of a query are checked

MAX_VERIFIED = 3  # verified candidates after which a search ends
MAX_BACKLOG_CANDIDATES = 3  # candidates tried while other queries wait


class CandidateSearch:
    """Candidates of one keyframe, best first.

    The search ends after `MAX_VERIFIED` verified candidates. While other queries wait it ends after the first
    verified one, and after `MAX_BACKLOG_CANDIDATES` tried ones.
    """

    def __init__(self, candidates: Iterable[int]) -> None:
        self._remaining = deque(candidates)
        self._tried_count = self._verified_count = 0

    def next_candidate(self, has_backlog: bool) -> int | None:
        """Return the next candidate to verify; None when there are none left or the budget is spent."""
        max_tried = MAX_BACKLOG_CANDIDATES if has_backlog else self._tried_count + 1
        max_verified = 1 if has_backlog else MAX_VERIFIED
        if not self._remaining or self._tried_count >= max_tried or self._verified_count >= max_verified:
            return None
        self._tried_count += 1
        return self._remaining.popleft()

    def count_verified(self) -> None:
        self._verified_count += 1
