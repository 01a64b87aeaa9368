"""The surest path, walked edge by edge: what one search for all goals is compared with."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from share.geometry import se3
from share.mapping.graph.edges import PoseEdge
from share.types import F64

Placed = Sequence[F64] | Mapping[int, F64] | F64


def surest(edges: Iterable[PoseEdge], start: int, goal: int) -> list[PoseEdge] | None:
    """The path of least summed trace(cov) as the edges to walk, None if there is none (Dijkstra 1959)."""
    touching: dict[int, list[PoseEdge]] = {}
    for edge in edges:
        for end in (edge.a, edge.b):
            touching.setdefault(end, []).append(edge)
    came: dict[int, tuple[int, PoseEdge]] = {}
    done: set[int] = set()
    heap: list[tuple[float, int, int, PoseEdge | None]] = [(0.0, start, start, None)]
    while heap:
        cost, here, previous, taken = heapq.heappop(heap)
        if here in done:
            continue
        done.add(here)
        if taken is not None:
            came[here] = (previous, taken)
        if here == goal:
            return _walk_back(came, start, goal)
        for road in touching.get(here, ()):
            there = road.b if road.a == here else road.a
            if there not in done:
                heapq.heappush(heap, (cost + road.cov_trace, there, here, road))
    return None


def covariance_between(path: Sequence[PoseEdge], start: int, poses: Placed) -> F64:
    """Covariance (6, 6) of T_start_goal along `path`, each step laid along the current `poses`."""
    cov = np.zeros((6, 6))
    here = start
    for edge in path:
        there, step = (
            (edge.b, edge.cov) if edge.a == here else (edge.a, se3.inverse_cov(edge.T_a_b, edge.cov))
        )
        cov = se3.compose_cov(se3.inverse(poses[here]) @ poses[there], cov, step)
        here = there
    return cov


def _walk_back(came: dict[int, tuple[int, PoseEdge]], start: int, goal: int) -> list[PoseEdge]:
    path = []
    while goal != start:
        goal, edge = came[goal]
        path.append(edge)
    return path[::-1]
