"""Overlap check: do two maps look alike wherever they overlap, not only where places were recognised?

A copy of a room matches as well as the room itself, so loops alone support a false merge. The evidence
against it is in pairs of views that, by the map, should show the same and do not. Place recognition
never proposes such pairs, so they are searched for: before a merge in the whole overlap, and during the
probation of a merge wherever an agent comes near views of the other map.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from share.geometry import se3
from share.mapping.loop_consistency import is_at_any
from share.mapping.loops import Loop
from share.mapping.map_graph import MapGraph
from share.mapping.missing_points import MissingRegions, missing_points, missing_regions
from share.mapping.recognition.verification import CameraView
from share.types import F64

# Views within both are from one spot and should look alike.
_NEAR_M = 1.0
_NEAR_RAD = 0.5
_MAX_PAIRS = 40  # compared before a merge
_MAX_COMPARED = 500  # nodes of a map for which the nearest nodes of the other are searched for
_NEIGHBOURS = 16  # nearest of those
_PROBATION_VIEWS = 40  # compared after a merge; probation ends then if both sums are zero
# A pair that moved by less is not compared again.
_SAME_M = 0.02
_SAME_RAD = 0.01
_MAX_CACHED = 4000  # pairs


class UsualShares(NamedTuple):
    """Bounds for two views of one place, as shares of the points that both should show: missing regions
    seldom have a larger one, found points seldom a smaller one."""

    missing: float
    found: float


# True pairs: found 0.62 to 0.75; copies: 0.55 to 0.60.
SAME_DAY = UsualShares(missing=0.06, found=0.55)
# A view of an earlier session: other light, and things have gone. True pairs miss 0.00 to 0.07 in the mean.
OTHER_DAY = UsualShares(missing=0.10, found=0.50)


class Comparison(NamedTuple):
    """A pair of views, and what is usual for views of one place."""

    regions: MissingRegions
    usual: UsualShares

    @property
    def excess_missing(self) -> float:
        return self.regions.missing_share - self.usual.missing

    @property
    def lack(self) -> float:
        """Return by how much too little is found."""
        return self.usual.found - self.regions.found_share


@dataclass(eq=False)
class JoinProbation:
    """Probation of a merge between two segments: sums over its views, floored at 0 (Page's CUSUM, Biometrika
    1954).

    missing: of the share of points in missing regions above what is usual; lost: of the share that is found
    below what is usual. Copies differ by single things, which are missing, and by much that is found less
    often. counted_at: pose of the last view that counted.
    """

    missing: float = 0.0
    lost: float = 0.0
    view_count: int = 0
    counted_at: F64 | None = None

    def add(self, comparison: Comparison) -> None:
        self.missing = cusum(self.missing, comparison)
        self.lost = max(0.0, self.lost + comparison.lack)


class OverlapCheck:
    """Overlap check of one graph. camera_views: by node id, as far as known.

    comparison_count: pairs of views compared since the start, 2 to 5 ms each.
    """

    def __init__(self, graph: MapGraph, camera_views: Mapping[int, CameraView]) -> None:
        self.comparison_count = 0
        self._graph, self._camera_views = graph, camera_views
        self._cache: dict[tuple[int, int], tuple[F64, MissingRegions]] = {}
        self._probations: dict[tuple[int, int], JoinProbation] = {}
        self._restored_count = 0

    def note_restored(self, count: int) -> None:
        """Set that nodes with smaller ids than this are of an earlier session."""
        self._restored_count = count

    def is_earlier(self, node_id: int) -> bool:
        """Return whether a node is of an earlier session."""
        return node_id < self._restored_count

    def is_on_probation(self, segment: int) -> bool:
        """Return whether a merge of this segment is on probation."""
        return any(segment in pair and self._is_one_map(pair) for pair in self._probations)

    def with_found_share(self, loop: Loop) -> Loop:
        """Return the loop with its found share, if both views are known."""
        a, b = (self._camera_views.get(n) for n in self._graph.loop_nodes(loop))
        if loop.found_share is not None or a is None or b is None:
            return loop
        return replace(loop, found_share=1 - missing_points(b, a, loop.T_a_b).missing_share)

    def compare_overlap(self, loop: Loop) -> list[Comparison]:
        """Compare the overlap of two maps (within one map: of two segments), placed as the loop says.

        Pairs views from about the same spot, each view once; in the order of b's nodes.
        """
        graph, (a, b) = self._graph, self._graph.loop_nodes(loop)
        nodes_a, nodes_b = (self._with_views(self._nodes_on_side(n, graph.is_same_map(a, b))) for n in (a, b))
        nodes_b = nodes_b[:: 1 + len(nodes_b) // _MAX_COMPARED]  # evenly, of many
        if not nodes_a or not nodes_b:
            return []
        T_b = graph.poses[a] @ loop.T_a_b @ se3.inverse(graph.poses[b])  # map of b in that of a
        poses_a, poses_b = (graph.poses.stack(nodes) for nodes in (nodes_a, nodes_b))
        pairs = _near_pairs(poses_a, T_b @ poses_b)
        comparisons = ((j, self._compare_views(nodes_a[i], nodes_b[j], T)) for i, j, T in pairs)
        return [
            comparison for _, comparison in sorted(_informative(comparisons, _MAX_PAIRS), key=lambda x: x[0])
        ]

    def begin_probation(self, loop: Loop) -> None:
        """Put the merge that this loop made on probation."""
        self._probations[self._segment_pair(loop)] = JoinProbation()

    def review_joins(self, node_id: int) -> Iterator[tuple[tuple[int, int], JoinProbation]]:
        """Compare a new node with each segment whose merge with the node's segment is on probation.

        Yields both segments and their probation.
        """
        segment = self._graph.odometry.nodes[node_id].segment
        for pair, probation in list(self._probations.items()):
            if segment in pair and self._is_one_map(pair):
                comparison = self._compare_nearest(node_id, pair[0] if segment == pair[1] else pair[1])
                pose = self._graph.poses[node_id]
                if comparison is None:
                    continue
                probation.view_count += 1
                if not _repeats_counted_view(probation, comparison, pose):
                    probation.add(comparison)
                    probation.counted_at = pose
                yield pair, probation
                is_clear = not probation.missing and not probation.lost
                if probation.view_count >= _PROBATION_VIEWS and is_clear:
                    self._probations.pop(pair, None)

    def end_probation(self, pair: tuple[int, int]) -> None:
        """Forget a merge that was undone."""
        self._probations.pop(pair, None)

    def _nodes_on_side(self, node_id: int, is_one_segment: bool) -> list[int]:
        segment = self._graph.odometry.nodes[node_id].segment
        if is_one_segment:
            return self._graph.odometry.segments[segment].nodes
        return self._graph.map_nodes(self._graph.reference_segments[segment])

    def _segment_pair(self, loop: Loop) -> tuple[int, int]:
        a, b = sorted(self._graph.segment(key) for key in (loop.a, loop.b))
        return a, b

    def _is_one_map(self, pair: tuple[int, int]) -> bool:
        return self._graph.reference_segments[pair[0]] == self._graph.reference_segments[pair[1]]

    def _compare_nearest(self, node_id: int, segment: int) -> Comparison | None:
        """Compare the node with the nearest view of the segment that is near enough and informative."""
        nodes = self._with_views(self._graph.odometry.segments[segment].nodes)
        if not nodes or node_id not in self._camera_views:
            return None
        poses = self._graph.poses
        pairs = _near_pairs(poses.stack(nodes), poses[node_id][None])
        comparisons = _informative(((j, self._compare_views(nodes[i], node_id, T)) for i, j, T in pairs), 1)
        return comparisons[0][1] if comparisons else None

    def _with_views(self, nodes: Sequence[int]) -> list[int]:
        return [n for n in nodes if n in self._camera_views]

    def _compare_views(self, a: int, b: int, T_a_b: F64) -> Comparison:
        is_same_day = self.is_earlier(a) == self.is_earlier(b)
        return Comparison(self._missing_regions(a, b, T_a_b), SAME_DAY if is_same_day else OTHER_DAY)

    def _missing_regions(self, a: int, b: int, T_a_b: F64) -> MissingRegions:
        """Cached: the same pairs are compared again for every further loop of a hypothesis."""
        if (cached := self._cache.get((a, b))) is not None:
            offset = se3.inverse(cached[0]) @ T_a_b
            if np.linalg.norm(offset[:3, 3]) < _SAME_M and se3.rotation_angle(offset) < _SAME_RAD:
                return cached[1]
        self.comparison_count += 1
        regions = missing_regions(self._camera_views[b], self._camera_views[a], T_a_b)
        if len(self._cache) >= _MAX_CACHED:
            self._cache.clear()
        self._cache[a, b] = T_a_b, regions
        return regions


def _repeats_counted_view(probation: JoinProbation, comparison: Comparison, pose: F64) -> bool:
    """Return whether a view shows what the last one showed: what has gone since another day is one thing,
    however many views miss it."""
    last = [] if probation.counted_at is None else [probation.counted_at]
    return comparison.usual is OTHER_DAY and is_at_any(pose, last)


def cusum(previous: float, comparison: Comparison) -> float:
    """Sum, floored at 0, of the missing share beyond what is usual (Page's CUSUM, Biometrika 1954)."""
    return max(0.0, previous + comparison.excess_missing)


def _informative(comparisons: Iterator[tuple[int, Comparison]], limit: int) -> list[tuple[int, Comparison]]:
    """The first `limit` comparisons with enough visible points."""
    enough = (pair for pair in comparisons if pair[1].regions.is_informative)
    return list(itertools.islice(enough, limit))


def _near_pairs(poses_a: F64, poses_b: F64) -> Iterator[tuple[int, int, F64]]:
    """Yield pairs of poses a (N, 4, 4), b (K, 4, 4) from about one spot as i, j, T_a_b.

    Nearest first, each pose in at most one pair. Of each b the `_NEIGHBOURS` nearest poses a are considered.
    """
    count = min(_NEIGHBOURS, len(poses_a))
    distance, rows = KDTree(poses_a[:, :3, 3]).query(
        poses_b[:, :3, 3], np.arange(1, count + 1), distance_upper_bound=_NEAR_M
    )
    is_near = np.isfinite(distance)
    cols = np.nonzero(is_near)[0]
    distance, rows = distance[is_near], rows[is_near]
    cosine = ((poses_a[rows, :3, :3] * poses_b[cols, :3, :3]).sum((1, 2)) - 1) / 2
    is_similar = cosine > np.cos(_NEAR_RAD)
    distance, rows, cols = distance[is_similar], rows[is_similar], cols[is_similar]
    used_a, used_b = set[int](), set[int]()
    for k in np.argsort(distance, kind="stable"):
        i, j = int(rows[k]), int(cols[k])
        if i not in used_a and j not in used_b:
            used_a.add(i)
            used_b.add(j)
            yield i, j, se3.inverse(poses_a[i]) @ poses_b[j]
