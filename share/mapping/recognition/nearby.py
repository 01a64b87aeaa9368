"""Which keyframes of its map a keyframe can be aligned with, by the map's poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Set as AbstractSet

import numpy as np

from share.geometry import se3
from share.mapping.map_graph import MapGraph

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
        if near_id in excluded or near_id not in eligible or not graph.is_same_map(node_id, near_id):
            continue
        if per_segment[segment] < _MAX_PER_SEGMENT:
            per_segment[segment] += 1
            chosen.append(near_id)
        if len(chosen) == _MAX_CANDIDATES:
            break
    return chosen


def _nearest_first(graph: MapGraph, node_id: int) -> list[int]:
    """Return the nodes of all maps within the limits, those that see most of what this one sees first."""
    T = graph.poses[node_id]
    node_ids, poses = graph.poses.near(T, _NEAR_M)
    (distance,), (angle,) = se3.pairwise_distances(T[None], poses)
    cost = np.where(angle < _NEAR_RAD, distance / _NEAR_M + angle / _NEAR_RAD, np.inf)
    order = np.argsort(cost, kind="stable")[: np.isfinite(cost).sum()]
    return [int(n) for n in node_ids[order]]
