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
from numpy.typing import NDArray
from scipy.spatial import KDTree

from share.geometry import se3
from share.mapping.loops import Loop
from share.mapping.map_graph import MapGraph
from share.mapping.recognition.refinement import transfer_keypoints
from share.mapping.recognition.verification import CameraView
from share.types import F64, I64
from share.vision.matching import hamming_rowwise

# Views within both are from one spot and should look alike.
_NEAR_M = 1.0
_NEAR_RAD = 0.5
_MIN_POINTS = 20  # visible in a pair of views; below, the pair is not informative
_MAX_PAIRS = 40  # compared before a merge
_MAX_COMPARED = 500  # nodes of a map for which the nearest nodes of the other are searched for
_NEIGHBOURS = 16  # nearest of those
_PROBATION_VIEWS = 40  # compared after a merge; probation ends then if both sums are zero
_FOUND_SHARE = 0.55  # of the points in both views: found in true pairs 0.62 to 0.75, in copies 0.55 to 0.60
# A pair that moved by less is not compared again.
_SAME_M = 0.02
_SAME_RAD = 0.01
_MAX_CACHED = 4000  # pairs


@dataclass(eq=False)
class JoinProbation:
    """Probation of a merge between two segments: sums over its views, floored at 0 (Page's CUSUM, Biometrika
    1954).

    missing: of the share of points in missing regions above the allowed one; lost: of the share that is
    found below `_FOUND_SHARE`. Copies differ by single things, which are missing, and by much that is found
    less often.
    """

    missing: float = 0.0
    lost: float = 0.0
    view_count: int = 0

    def add(self, comparison: MissingRegions, allowed_share: float) -> None:
        self.view_count += 1
        self.missing = cusum(self.missing, comparison, allowed_share)
        self.lost = max(0.0, self.lost + _FOUND_SHARE - comparison.found_share)


class OverlapCheck:
    """Overlap check of one graph. camera_views: by node id, as far as known.

    comparison_count: pairs of views compared since the start, 2 to 5 ms each.
    """

    def __init__(self, graph: MapGraph, camera_views: Mapping[int, CameraView]) -> None:
        self.comparison_count = 0
        self._graph, self._camera_views = graph, camera_views
        self._cache: dict[tuple[int, int], tuple[F64, MissingRegions]] = {}
        self._probations: dict[tuple[int, int], JoinProbation] = {}

    def with_found_share(self, loop: Loop) -> Loop:
        """Return the loop with its found share, if both views are known."""
        a, b = (self._camera_views.get(n) for n in self._graph.loop_nodes(loop))
        if loop.found_share is not None or a is None or b is None:
            return loop
        return replace(loop, found_share=1 - missing_points(b, a, loop.T_a_b).missing_share)

    def compare_overlap(self, loop: Loop) -> list[MissingRegions]:
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
        return [comparison for _, comparison in sorted(_informative(comparisons, _MAX_PAIRS))]

    def begin_probation(self, loop: Loop) -> None:
        """Put the merge that this loop made on probation."""
        self._probations[self._segment_pair(loop)] = JoinProbation()

    def review_joins(
        self, node_id: int, allowed_share: float
    ) -> Iterator[tuple[tuple[int, int], JoinProbation]]:
        """Compare a new node with each segment whose merge with the node's segment is on probation.

        allowed_share: share of a view that may be missing. Yields both segments and their probation.
        """
        segment = self._graph.odometry.nodes[node_id].segment
        for pair, probation in list(self._probations.items()):
            if segment in pair and self._is_one_map(pair):
                comparison = self._compare_nearest(node_id, pair[0] if segment == pair[1] else pair[1])
                if comparison is None:
                    continue
                probation.add(comparison, allowed_share)
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

    def _compare_nearest(self, node_id: int, segment: int) -> MissingRegions | None:
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

    def _compare_views(self, a: int, b: int, T_a_b: F64) -> MissingRegions:
        """Cached: the same pairs are compared again for every further loop of a hypothesis."""
        if (cached := self._cache.get((a, b))) is not None:
            offset = se3.inverse(cached[0]) @ T_a_b
            if np.linalg.norm(offset[:3, 3]) < _SAME_M and se3.rotation_angle(offset) < _SAME_RAD:
                return cached[1]
        self.comparison_count += 1
        comparison = missing_regions(self._camera_views[b], self._camera_views[a], T_a_b)
        if len(self._cache) >= _MAX_CACHED:
            self._cache.clear()
        self._cache[a, b] = T_a_b, comparison
        return comparison


def cusum(previous: float, comparison: MissingRegions, allowed_share: float) -> float:
    """Sum, floored at 0, of the missing share beyond `allowed_share` (Page's CUSUM, Biometrika 1954)."""
    return max(0.0, previous + comparison.missing_share - allowed_share)


def _informative(
    comparisons: Iterator[tuple[int, MissingRegions]], limit: int
) -> list[tuple[int, MissingRegions]]:
    """The first `limit` comparisons with enough visible points."""
    return list(
        itertools.islice(
            (comparison for comparison in comparisons if comparison[1].visible >= _MIN_POINTS), limit
        )
    )


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


# Missing points of two views, if the two stand as verification says. Two places that look alike share most
# points, but what only one of them has is missing in the other. Single points are missing anywhere (missed
# detections, occlusion); where all points of a patch of the image are missing, a *thing* is missing: a
# poster, a door, a box. Distributions: docs/understand/place-recognition.md.

_FOUND_PX = 6.0  # radius within which a point is found
_REGION_FOUND_PX = 15.0  # the same for patches: the map may have drifted
_MAX_BITS = 90  # descriptor distance of a found point
_OCCLUDER_PX = 40.0  # radius of the keypoints that may occlude a point
_BORDER_SHARE = 0.03  # of each side of the image, where the detector finds nothing
# A point is occluded if all keypoints around it have inverse depths above ratio * rho + offset.
_OCCLUSION_RATIO = 1.2
_OCCLUSION_RHO = 0.02  # 1/m
_REGION_RAD = 0.1  # radius of a patch
_MIN_REGION_POINTS = 10  # visible points in a patch: if none is found, the patch is missing


class MissingPoints(NamedTuple):
    """Points of both views that should be visible in the other, and how many are found."""

    visible: int
    found: int

    @property
    def missing_share(self) -> float:
        """Share of the visible points that are not found; 0 if none is visible."""
        return 1 - self.found / self.visible if self.visible else 0.0


class MissingRegions(NamedTuple):
    """Points of both views that should be visible in the other, those in patches without any found, and those
    found."""

    visible: int
    missing: int
    found: int

    @property
    def missing_share(self) -> float:
        """Share of the visible points in missing patches; 0 if none is visible."""
        return self.missing / self.visible if self.visible else 0.0

    @property
    def found_share(self) -> float:
        """Share of the visible points that are found, a little off too; 1 if none is visible."""
        return self.found / self.visible if self.visible else 1.0


def missing_points(query: CameraView, candidate: CameraView, T_c_q: F64) -> MissingPoints:
    """Count visible and found points, given T_c_q (4, 4): the query's body in the candidate's body frame."""
    in_candidate, in_query = _expected_both_ways(query, candidate, T_c_q, _FOUND_PX)
    return MissingPoints(
        len(in_candidate.is_found) + len(in_query.is_found),
        int(in_candidate.is_found.sum() + in_query.is_found.sum()),
    )


def missing_regions(query: CameraView, candidate: CameraView, T_c_q: F64) -> MissingRegions:
    """Count visible points and those in missing patches.

    For views from about one spot: within 1 m little else is missing in a true pair. Farther apart, things
    occlude each other without a keypoint to show it.
    """
    in_candidate, in_query = _expected_both_ways(query, candidate, T_c_q, _REGION_FOUND_PX)
    return MissingRegions(
        len(in_candidate.is_found) + len(in_query.is_found),
        _count_in_missing_regions(in_candidate) + _count_in_missing_regions(in_query),
        int(in_candidate.is_found.sum() + in_query.is_found.sum()),
    )


class _ExpectedPoints(NamedTuple):
    """Points of one view that should be visible in the other: position there (N, 2), is_found (N,)."""

    uv: F64
    is_found: NDArray[np.bool_]


def _expected_both_ways(
    query: CameraView, candidate: CameraView, T_c_q: F64, reach_px: float
) -> tuple[_ExpectedPoints, _ExpectedPoints]:
    T = se3.inverse(candidate.T_body_cam0) @ T_c_q @ query.T_body_cam0
    return _expected_points(T, query, candidate, reach_px), _expected_points(
        se3.inverse(T), candidate, query, reach_px
    )


def _expected_points(T: F64, source: CameraView, target: CameraView, reach_px: float) -> _ExpectedPoints:
    target_keypoints = target.keypoints
    if not len(source.view) or not len(target_keypoints):
        return _ExpectedPoints(np.zeros((0, 2)), np.zeros(0, bool))
    moved = transfer_keypoints(T, source.keypoints.T).T
    inside = np.flatnonzero(_is_inside(moved, target_keypoints))
    moved = moved[inside]
    rows, cols, px = _near_keypoints(target.focal * moved[:, :2], target.focal * target_keypoints[:, :2])
    near_rows, near_cols = rows[px < reach_px], cols[px < reach_px]
    bits = hamming_rowwise(source.view.descriptors[inside[near_rows]], target.view.descriptors[near_cols])
    is_found = np.zeros(len(inside), bool)
    is_found[near_rows[bits <= _MAX_BITS]] = True
    nearby_rho = np.full(len(inside), np.inf)  # least inverse depth of keypoints around
    np.fmin.at(nearby_rho, rows, target_keypoints[cols, 2])
    is_visible = nearby_rho <= _OCCLUSION_RATIO * moved[:, 2] + _OCCLUSION_RHO
    return _ExpectedPoints(moved[is_visible, :2], is_found[is_visible])


def _count_in_missing_regions(expected: _ExpectedPoints) -> int:
    """Count points in patches without a found point."""
    missing_uv = expected.uv[~expected.is_found]
    is_isolated = ~_are_within(missing_uv, expected.uv[expected.is_found], _REGION_RAD).any(1)
    is_in_region = _are_within(missing_uv[is_isolated], missing_uv, _REGION_RAD).sum(1) >= _MIN_REGION_POINTS
    return int(is_in_region.sum())


def _are_within(a: F64, b: F64, radius: float) -> NDArray[np.bool_]:
    """Mask (N, K) of points a (N, 2) and b (K, 2) nearer than `radius`."""
    square = (a[:, :1] - b[:, 0]) ** 2 + (a[:, 1:] - b[:, 1]) ** 2
    return np.asarray(square < radius**2)


def _is_inside(moved: F64, target: F64) -> NDArray[np.bool_]:
    """Mask of points in the part of the image where the target has keypoints; False for NaN."""
    low, high = target[:, :2].min(0), target[:, :2].max(0)
    margin = _BORDER_SHARE * (high - low)
    return np.asarray(((moved[:, :2] > low + margin) & (moved[:, :2] < high - margin)).all(1))


def _near_keypoints(a: F64, b: F64) -> tuple[I64, I64, F64]:
    """Pairs of points a (N, 2) and b (K, 2), pixels, that are near: rows, columns, distances (M,)."""
    distances = KDTree(a).sparse_distance_matrix(KDTree(b), _OCCLUDER_PX, output_type="ndarray")
    return distances["i"], distances["j"], distances["v"]
