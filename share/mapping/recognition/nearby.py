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
    reference_segment = graph.reference_segments[graph.odometry.nodes[node_id].segment]
    excluded = {node_id, *graph.odometry.neighbours(node_id)}
    nodes = [n for n in graph.map_nodes(reference_segment) if n in eligible and n not in excluded]
    if not nodes:
        return []
    poses = np.array([graph.poses[n] for n in nodes])
    (distance,), (angle,) = se3.pairwise_distances(graph.poses[node_id][None], poses)
    cost = distance / _NEAR_M + angle / _NEAR_RAD
    near = np.flatnonzero((distance < _NEAR_M) & (angle < _NEAR_RAD))
    chosen: list[int] = []
    per_segment = Counter[int]()
    for i in near[np.argsort(cost[near], kind="stable")]:
        segment = graph.odometry.nodes[nodes[i]].segment
        if per_segment[segment] < _MAX_PER_SEGMENT and len(chosen) < _MAX_CANDIDATES:
            per_segment[segment] += 1
            chosen.append(nodes[i])
    return chosen
