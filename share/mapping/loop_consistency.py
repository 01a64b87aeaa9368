"""Weight of a set of consistent loops, and the loops and segments that hold a map together.

Neighbouring views of one spot are not independent, so places are counted, not loops. Places that only look
alike share fewer points than views of one place, so a set weighs its places times the square of its mean
found share.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from share.mapping.loops import Loop
from share.mapping.map_graph import MapGraph
from share.types import F64, I64

PLACE_M = 0.5  # views further apart than this are different places
PLACE_RAD = 0.35  # views rotated further than this are different places
NEAR_M = 2.5  # views further apart than this do not support a merge
NEAR_RAD = 0.8  # views rotated further than this do not support a merge
_FEW_PLACES = 5
_DEFAULT_FOUND_SHARE = 0.5  # where not computed: that of most true loops


@dataclass(frozen=True)
class LoopEvidence:
    """Evidence of a set of consistent loops whose two views are near each other.

    places: number of places; found_share: mean share of common points found; keyframes: number of keyframes
    on the side that has fewer, since one misleading view can produce many false loops.
    """

    places: int = 0
    found_share: float = 0.0
    keyframes: int = 0

    @property
    def weight(self) -> float:
        return self.places * self.found_share**2

    def outweighs(self, other: LoopEvidence, ratio: float) -> bool:
        """Return whether its weight is more than `ratio` times the other's, by all places, or by at most
        `_FEW_PLACES` of either: along an aisle and its copy as many places agree as one passes, and only the
        found shares differ."""
        few = [replace(x, places=min(x.places, _FEW_PLACES)) for x in (self, other)]
        return self.weight > ratio * other.weight or few[0].weight > ratio * few[1].weight

    def __str__(self) -> str:
        return f"{self.places} places (weight {self.weight:.2f})"


def is_near(loop: Loop) -> bool:
    """Return whether both views are from about the same spot: only those distinguish look-alike places."""
    distance_m, angle_rad = loop.view_offset
    return distance_m <= NEAR_M and angle_rad <= NEAR_RAD


def weigh_loops(loops: Sequence[Loop], graph: MapGraph, sides: Mapping[int, int]) -> LoopEvidence:
    """Weigh `loops`. sides: side of the loops on which each segment is; segments of one side share a frame.

    Places are counted on each side, the least counts; loops of distant views are ignored."""
    near_loops = [loop for loop in loops if is_near(loop)]
    if not near_loops:
        return LoopEvidence()
    poses_by_side: dict[int, list[F64]] = {}
    for loop in near_loops:
        for node_id in graph.loop_nodes(loop):
            side = sides[graph.odometry.nodes[node_id].segment]
            poses_by_side.setdefault(side, []).append(graph.poses[node_id])
    count = min(count_places(np.array(poses)) for poses in poses_by_side.values())
    found_shares = [loop.found_share for loop in near_loops if loop.found_share is not None]
    found_share = float(np.mean(found_shares)) if found_shares else _DEFAULT_FOUND_SHARE
    keyframes = min(len({loop.a for loop in near_loops}), len({loop.b for loop in near_loops}))
    return LoopEvidence(count, found_share, keyframes)


def count_places(poses: F64, max_count: int | None = None) -> int:
    """Count the places of poses (N, 4, 4), greedily: a pose far from all places before is a new one.

    Counting stops at `max_count`.
    """
    count = 0
    while len(poses) and count != max_count:
        count += 1
        poses = poses[~_is_one_place(poses[0], poses)]
    return count


def is_at_any(T: F64, poses: Sequence[F64]) -> bool:
    """Return whether pose T (4, 4) is at the place of any of `poses`."""
    return len(poses) > 0 and bool(_is_one_place(T, np.array(poses)).any())


def _is_one_place(T: F64, poses: F64) -> NDArray[np.bool_]:
    """Mask of poses (N, 4, 4) at the place of T (4, 4). T itself always is, despite rounding."""
    shift = poses[:, :3, 3] - T[:3, 3]
    cosine = (poses[:, :3, :3].reshape(-1, 9) @ T[:3, :3].ravel() - 1) / 2
    near = ((shift**2).sum(1) <= PLACE_M**2) & (cosine >= min(np.cos(PLACE_RAD), 1 - 1e-9))
    return np.asarray(near)


# Connectivity of a map: which loops, and which segments, it cannot do without.


class Cut(NamedTuple):
    """edges: those that are cut; start_side: the nodes that are still connected with the start."""

    edges: list[int]
    start_side: set[int]


def minimum_cut(edges: Sequence[tuple[int, int]], start: int, goal: int) -> Cut:
    """Return the fewest edges, by index, without which no path leads from `start` to `goal`.

    edges: loops, by the two segments that each connects. Source: Ford and Fulkerson 1956. Raises ValueError
    if start is goal.
    """
    if start == goal:
        raise ValueError("start and goal of a cut must be two segments")
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    names = sorted({start, goal, *(end for edge in edges for end in edge)})
    index = {name: i for i, name in enumerate(names)}
    ends: I64 = np.array([(index[a], index[b]) for a, b in edges], np.int64).reshape(-1, 2)
    directed = np.concatenate([ends, ends[:, ::-1]])
    n = len(names)
    capacity = csr_array((np.ones(len(directed), np.int32), (directed[:, 0], directed[:, 1])), shape=(n, n))
    capacity.sum_duplicates()
    flow = maximum_flow(capacity, index[start], index[goal]).flow
    residual_capacity = capacity - flow
    residual_capacity.data[residual_capacity.data < 0] = 0
    residual_capacity.eliminate_zeros()
    is_reachable = np.zeros(n, bool)
    is_reachable[breadth_first_order(residual_capacity, index[start], return_predecessors=False)] = True
    is_cut = is_reachable[ends[:, 0]] != is_reachable[ends[:, 1]]
    return Cut(np.flatnonzero(is_cut).tolist(), {names[i] for i in np.flatnonzero(is_reachable)})


def articulation_segments(segment_pairs: Iterable[tuple[int, int]]) -> set[int]:
    """Return the segments without which the rest of their map would be disconnected.

    They are the articulation points of the graph of `segment_pairs` (Hopcroft and Tarjan, CACM 1973).
    """
    neighbours: dict[int, list[int]] = {}
    for a, b in segment_pairs:
        if a != b:
            neighbours.setdefault(a, []).append(b)
            neighbours.setdefault(b, []).append(a)
    depth: dict[int, int] = {}
    low: dict[int, int] = {}
    out: set[int] = set()
    for root in neighbours:
        if root in depth:
            continue
        depth[root] = low[root] = 0
        stack, children = [(root, iter(neighbours[root]))], 0
        while stack:
            node, others = stack[-1]
            for other in others:
                if other not in depth:
                    depth[other] = low[other] = len(stack)
                    stack.append((other, iter(neighbours[other])))
                    break
                low[node] = min(low[node], depth[other])
            else:
                stack.pop()
                if not stack:
                    continue
                before = stack[-1][0]
                low[before] = min(low[before], low[node])
                if before == root:
                    children += 1
                elif low[node] >= depth[before]:
                    out.add(before)
        if children > 1:
            out.add(root)
    return out
