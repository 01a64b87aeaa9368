"""The map graph: poses, edges, and which segments form one map.

A map is a set of segments connected by loops. Its reference segment is the one of least rank, among equals
the oldest; it gives the map its name, and its oldest keyframe stays where its odometry put it.
Maps follow from the loops alone, so removing a loop undoes its merge.
"""

from __future__ import annotations

import itertools
from bisect import insort
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from share.geometry import se3
from share.mapping.graph.edges import PoseEdge, inflate_span
from share.mapping.graph_edges import GraphEdges
from share.mapping.loops import KeyframeKey, Loop, RelativePose
from share.mapping.pose_table import PoseTable
from share.mapping.segments import OdometrySegments
from share.types import F64, I64, Keyframe

# Factor on the covariance of odometry over several keyframes: it shares its measurements with the steps
# between.
_SHARED_INFORMATION = 2.0


def _rescaled(edge: PoseEdge, log_change: float, covariance_ratio: float) -> PoseEdge:
    T_a_b = rescale_translation(edge.T_a_b, log_change)
    return replace(edge, T_a_b=T_a_b, cov=covariance_ratio * edge.cov)


def rescale_translation(T: F64, log_scale: float) -> F64:
    """Divide the translation of T (4, 4) by exp(log_scale)."""
    return se3.from_rt(T[:3, :3], T[:3, 3] * np.exp(-log_scale)) if log_scale else T


class MapGraph:
    """Nodes, edges and maps.

    poses: T_map_body (4, 4) by node id. gravity_factors: up direction over its sigma, where known
    (`share.mapping.graph.gravity`). reference_segments: for each segment the reference segment of its map.
    maps: by reference segment, the segments with keyframes in order of precedence. split_segments: segments
    that changed map because loops were removed; the reader clears it. log_scales: log of the factor by which
    each agent's odometry is too long; covariance_scales: factor on its variances; agents without an entry
    have 0 and 1.
    """

    def __init__(self) -> None:
        self.odometry = OdometrySegments()
        self.edges = GraphEdges()
        self.poses = PoseTable()
        self.gravity_factors: dict[int, F64] = {}
        self.reference_segments: list[int] = []
        self.maps: dict[int, list[int]] = {}
        self.split_segments: set[int] = set()
        self.loop_counts: Counter[tuple[int, int]] = Counter()  # by pair of segments, the older first
        self.log_scales: dict[str, float] = {}
        self.covariance_scales: dict[str, float] = {}
        self.unsolved_maps: dict[int, None] = {}  # reference segments, longest unsolved first
        self._joins_changed = False  # `loop_counts` has other pairs than at the last `update_maps`

    def add_keyframe(
        self, agent: str, keyframe: Keyframe, cov: F64, gravity_factor: F64, rank: int = 0
    ) -> int:
        """Add a keyframe and return its node id.

        cov (6, 6): of its step, inflated; gravity_factor (3,). rank: that of a segment which it begins.
        """
        node_id = self.odometry.add_keyframe(agent, keyframe, rank)
        self.add_node(node_id, keyframe.T_ref_body, cov, gravity_factor)
        return node_id

    def add_node(self, node_id: int, T_ref_body: F64, cov: F64, gravity_factor: F64) -> None:
        """Pose a new node by odometry as sent, and connect it to the previous node of its segment, if any."""
        node, previous = self.odometry.nodes[node_id], self.odometry.previous_node(node_id)
        agent = self.odometry.segments[node.segment].agent
        T_ref_body = rescale_translation(T_ref_body, self.log_scales.get(agent, 0.0))
        self.reference_segments += range(len(self.reference_segments), len(self.odometry.segments))
        if len(self.odometry.segments[node.segment].nodes) == 1:
            self._add_to_map(node.segment)
        if previous is None:
            self.poses[node_id] = node.T_odom_body
        else:
            self.edges.add(
                PoseEdge(previous, node_id, T_ref_body, cov * self.covariance_scales.get(agent, 1.0))
            )
            self.poses[node_id] = se3.orthonormal(self.poses[previous] @ T_ref_body)
        if gravity_factor.any():
            self.gravity_factors[node_id] = gravity_factor
        self.edges.mark_moved([node_id])

    def add_spans(self, node_id: int, keyframe: Keyframe) -> None:
        """Add the keyframe's odometry relative to earlier keyframes, where its segment has them."""
        odometry, edges = self.odometry, self.edges
        agent, segment = odometry.nodes[node_id].key.agent, odometry.nodes[node_id].segment
        log_scale, covariance_scale = self.log_scales.get(agent, 0.0), self.covariance_scales.get(agent, 1.0)
        earlier = keyframe.earlier
        for earlier_id, T, cov in zip(earlier.ids.tolist(), earlier.T_earlier_body, earlier.cov, strict=True):
            key = KeyframeKey(agent, earlier_id)
            if not odometry.has_keyframe(key) or odometry.nodes[odometry.node_id(key)].segment != segment:
                continue  # removed, or the segment was split
            earlier_node, T_a_b = odometry.node_id(key), se3.orthonormal(T.astype(np.float64))
            steps = odometry.nodes[node_id].ordinal - odometry.nodes[earlier_node].ordinal
            cov_a_b = covariance_scale * inflate_span(
                T_a_b, _SHARED_INFORMATION * cov.astype(np.float64), steps
            )
            edges.add_span(PoseEdge(earlier_node, node_id, rescale_translation(T_a_b, log_scale), cov_a_b))

    def remove_node(self, node_id: int) -> None:
        """Remove a node that has no edges."""
        segment = self.odometry.nodes[node_id].segment
        self.edges.remove_node(node_id)
        self.odometry.remove_node(node_id)
        if not self.odometry.segments[segment].nodes:
            self._remove_from_map(segment)
        del self.poses[node_id]
        self.gravity_factors.pop(node_id, None)

    # Changes

    def add_loop(self, loop: Loop) -> None:
        """Add a loop; the maps of its ends become one."""
        a, b = self.loop_nodes(loop)
        self.add_loop_edge(PoseEdge(a, b, loop.T_a_b, loop.cov), loop)
        if not self.is_same_map(a, b):
            self.update_maps()
        self.unsolved_maps = dict.fromkeys(
            [*(self.reference_segments[f] for f in self.unsolved_maps), self.reference_segment(loop.a)]
        )

    def add_loop_edge(self, edge: PoseEdge, loop: Loop) -> None:
        """Add a loop as an edge. Call `update_maps` afterwards if it connects two maps."""
        self.edges.add(edge, loop)
        pair = self.segment_pair(edge)
        self._joins_changed |= pair not in self.loop_counts
        self.loop_counts[pair] += 1

    def remove_loop_edge(self, edge_id: int) -> None:
        """Remove a loop's edge. Call `update_maps` afterwards if it was the last between its segments."""
        pair = self.segment_pair(self.edges.by_id[edge_id])
        self.loop_counts[pair] -= 1
        if not self.loop_counts[pair]:
            del self.loop_counts[pair]
            self._joins_changed = True
        self.edges.remove(edge_id)

    def drop_loops(self, edge_ids: Sequence[int]) -> tuple[Loop, ...]:
        """Remove loops by edge id and undo the merges that depended on them. Return the loops."""
        dropped = tuple(self.edges.loops[n] for n in edge_ids)
        touched_maps = {self.reference_segment(key) for loop in dropped for key in (loop.a, loop.b)}
        segments = [s for reference_segment in touched_maps for s in self.map_segments(reference_segment)]
        for edge_id in edge_ids:
            self.remove_loop_edge(edge_id)
        before = self.reference_segments
        self.update_maps()
        self.split_segments |= {s for s in segments if self.reference_segments[s] != before[s]}
        for reference_segment in sorted({self.reference_segments[s] for s in segments}):
            anchor = self.anchor(reference_segment)
            self.move_map(
                reference_segment, self.odometry.nodes[anchor].T_odom_body @ se3.inverse(self.poses[anchor])
            )
            self.unsolved_maps[reference_segment] = None
        return dropped

    def align_maps(self, loop: Loop) -> F64:
        """Move the map of lower precedence rigidly to where the loop puts it. Return the motion (4, 4)."""
        if self.rank(self.reference_segment(loop.a)) > self.rank(self.reference_segment(loop.b)):
            loop = loop.reverse()
        a, b = self.loop_nodes(loop)
        T: F64 = self.poses[a] @ loop.T_a_b @ se3.inverse(self.poses[b])
        self.move_map(self.reference_segment(loop.b), T)
        return se3.orthonormal(T)

    def move_map(self, reference_segment: int, T: F64) -> None:
        """Transform a whole map rigidly by T (4, 4) from the left."""
        node_ids = self.map_nodes(reference_segment)
        self.poses.assign(node_ids, se3.orthonormal(T) @ self.poses.stack(node_ids))
        self.edges.mark_moved(node_ids)

    def rescale_odometry(self, agent: str, log_scale: float, covariance_scale: float) -> None:
        """Set an agent's log scale and covariance scale; its maps need to be solved again."""
        log_change = log_scale - self.log_scales.get(agent, 0.0)
        covariance_ratio = covariance_scale / self.covariance_scales.get(agent, 1.0)
        self.log_scales[agent], self.covariance_scales[agent] = log_scale, covariance_scale
        for segment_index in self.odometry.live_segments_of(agent):
            segment = self.odometry.segments[segment_index]
            for before, after in itertools.pairwise(segment.nodes):
                edge_id, edge = self._find_odometry_edge(before, after)
                self.edges.remove(edge_id)
                self.edges.add(_rescaled(edge, log_change, covariance_ratio))
            incident = {edge_id for n in segment.nodes for edge_id in self.edges.incident(n)}
            for edge_id in sorted(incident & self.edges.spans):
                edge = self.edges.by_id[edge_id]
                self.edges.remove(edge_id)
                self.edges.add_span(_rescaled(edge, log_change, covariance_ratio))
            self.unsolved_maps.setdefault(self.reference_segments[segment_index])

    def propagate(self, node_ids: Iterable[int]) -> None:
        """Pose nodes, in order, by odometry from the previous ones."""
        for node_id in node_ids:
            previous = self.odometry.previous_node(node_id)
            if previous is not None:
                T = self.poses[previous] @ self.odometry_edge(previous, node_id).T_a_b
                self.poses[node_id] = se3.orthonormal(T)

    # Queries

    def loop_nodes(self, loop: Loop) -> tuple[int, int]:
        """Nodes of a loop's keyframes. Raises ValueError if one is unknown."""
        return self.odometry.node_id(loop.a), self.odometry.node_id(loop.b)

    def odometry_edge(self, previous: int, node_id: int) -> PoseEdge:
        """Odometry edge from a node to the next one of its segment."""
        _, edge = self._find_odometry_edge(previous, node_id)
        return edge if edge.a == previous else edge.reverse()

    def _find_odometry_edge(self, previous: int, node_id: int) -> tuple[int, PoseEdge]:
        for edge_id in self.edges.incident(node_id):
            edge = self.edges.by_id[edge_id]
            is_step = edge_id not in self.edges.loops and edge_id not in self.edges.spans
            if is_step and previous in (edge.a, edge.b):
                return edge_id, edge
        raise ValueError(f"no odometry edge from node {previous} to {node_id}")

    def segment(self, key: KeyframeKey) -> int:
        return self.odometry.nodes[self.odometry.node_id(key)].segment

    def reference_segment(self, key: KeyframeKey) -> int:
        return self.reference_segments[self.segment(key)]

    def is_same_map(self, a: int, b: int) -> bool:
        segment_a, segment_b = self.odometry.nodes[a].segment, self.odometry.nodes[b].segment
        return self.reference_segments[segment_a] == self.reference_segments[segment_b]

    def map_id(self, segment: int) -> str:
        """Name of the map that contains a segment."""
        # A damaged file may lack all keyframes of the newest segments.
        is_known = segment < len(self.reference_segments)
        return self.odometry.segments[self.reference_segments[segment] if is_known else segment].name

    def find_map(self, map_id: str) -> int:
        """Reference segment of the map of this name. Raises ValueError if there is none."""
        if (reference_segment := self.odometry.by_name.get(map_id)) not in self.maps:
            raise ValueError(f"there is no map {map_id}")
        return reference_segment

    def rank(self, segment: int) -> tuple[int, int]:
        """Order of precedence: the segment with the least value is the reference of its map."""
        return self.odometry.segments[segment].rank, segment

    def map_segments(self, reference_segment: int) -> list[int]:
        """Segments of a map that have keyframes, in order of precedence."""
        return list(self.maps.get(reference_segment, ()))

    def map_size(self, reference_segment: int) -> int:
        """Number of keyframes of a map."""
        segments = self.odometry.segments
        return sum(len(segments[s].nodes) for s in self.maps.get(reference_segment, ()))

    def map_nodes(self, reference_segment: int) -> list[int]:
        return [n for s in self.map_segments(reference_segment) for n in self.odometry.segments[s].nodes]

    def near(self, node_id: int, max_m: float) -> tuple[I64, F64]:
        """Nodes (N,) of a node's map whose positions are nearer than `max_m` to its own, and their poses
        (N, 4, 4). At the origin there are nodes of all maps."""
        node_ids, poses = self.poses.near(self.poses[node_id], max_m)
        if len(self.maps) == 1:
            return node_ids, poses
        nodes = self.odometry.nodes
        own = set(self.map_segments(self.reference_segments[nodes[node_id].segment]))
        is_own = np.array([nodes[n].segment in own for n in node_ids.tolist()], bool)
        return node_ids[is_own], poses[is_own]

    def anchor(self, reference_segment: int) -> int:
        """Node that fixes the gauge of a map."""
        return self.odometry.segments[reference_segment].nodes[0]

    def T_map_odom(self, node_id: int) -> F64:
        """T_map_odom (4, 4) at this node."""
        T_odom_body = self.odometry.nodes[node_id].T_odom_body
        return se3.orthonormal(self.poses[node_id] @ se3.inverse(T_odom_body))

    def relative_pose(self, a: int, b: int) -> F64:
        """T_a_b (4, 4) of two nodes of one map."""
        return se3.inverse(self.poses[a]) @ self.poses[b]

    def relative_estimates(self, a: int, goals: Sequence[int]) -> RelativePose:
        """Poses (N, 4, 4) of the goals relative to node a, with covariances along the paths of least
        covariance.

        Raises ValueError if a goal is in another map.
        """
        covs = self.edges.covariance_paths.covariances_from(a, goals, self.poses)
        for goal, cov in zip(goals, covs, strict=True):
            if cov is None:
                raise ValueError(f"nodes {a} and {goal} are not in one map")
        return RelativePose(se3.inverse(self.poses[a]) @ self.poses.stack(goals), np.array(covs))

    def segment_pair(self, edge: PoseEdge) -> tuple[int, int]:
        """The segments at an edge's ends, the older first."""
        a, b = (self.odometry.nodes[end].segment for end in (edge.a, edge.b))
        return (a, b) if a < b else (b, a)

    def update_maps(self) -> None:
        """Recompute the reference segment of every segment: the connected components of the loops. Costs
        nothing while the same segments are connected."""
        if not self._joins_changed:
            return
        self._joins_changed = False
        root = list(range(len(self.reference_segments)))

        def find(i: int) -> int:
            while root[i] != i:
                i = root[i]
            return i

        for pair in self.loop_counts:
            low, high = sorted(map(find, pair), key=self.rank)
            root[high] = low
        self.reference_segments = [find(i) for i in range(len(root))]
        self.maps = {}
        for segment in sorted(self.odometry.live_segments):
            self._add_to_map(segment)

    def _add_to_map(self, segment: int) -> None:
        insort(self.maps.setdefault(self.reference_segments[segment], []), segment, key=self.rank)

    def _remove_from_map(self, segment: int) -> None:
        segments = self.maps[self.reference_segments[segment]]
        segments.remove(segment)
        if not segments:
            del self.maps[self.reference_segments[segment]]
