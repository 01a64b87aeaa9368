"""Where everything lies: poses by map, the edges between them, and which stretches are one map.

A map is a set of stretches that loops connect; it is named after its founder, the first to have come of
those of the least rank. The founder's oldest keyframe stays where its odometry says: that
is the gauge. Maps are derived from the loops alone, so taking a loop back takes its join back.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from share.geometry import se3
from share.mapping.graph.covariance import CovariancePaths
from share.mapping.graph.edges import PoseEdge
from share.mapping.graph.updates import GraphUpdate
from share.mapping.loops import KeyframeKey, Loop, RelativePose
from share.mapping.segments import OdometrySegments
from share.types import F64, Keyframe

# ---- The edges of the pose graph by number, and what of it the solver does not know yet.


class GraphEdges:
    """Odometry and loops between numbered poses."""

    def __init__(self) -> None:
        self.covariance_paths = CovariancePaths()
        self.by_id: dict[int, PoseEdge] = {}
        self.loops: dict[int, Loop] = {}  # of those edges that are loops, oldest first
        self._incident: dict[int, set[int]] = {}
        self._next_id = 0
        self.is_reset = True  # the solver knows nothing yet
        self._pending_edges: set[int] = set()  # edges that the solver does not have
        self._sent_nodes: set[int] = set()  # poses that the solver has
        self._moved_nodes: set[int] = set()  # poses that it has otherwise, or not at all
        self._removed_edges: set[int] = set()  # edges that it has, but should not
        self._removed_nodes: set[int] = set()  # poses that it has, but should not

    def add(self, edge: PoseEdge, loop: Loop | None = None) -> int:
        """The number of the new edge; with a loop, it may be false."""
        edge_id, self._next_id = self._next_id, self._next_id + 1
        self.by_id[edge_id] = edge
        self._pending_edges.add(edge_id)
        if loop is not None:
            self.loops[edge_id] = loop
        for end in (edge.a, edge.b):
            self._incident.setdefault(end, set()).add(edge_id)
        self.covariance_paths.add(edge)
        return edge_id

    def remove(self, edge_id: int) -> None:
        edge = self.by_id.pop(edge_id)
        self.loops.pop(edge_id, None)
        for end in (edge.a, edge.b):
            self._incident[end].discard(edge_id)
        self.covariance_paths.remove(edge)
        if edge_id in self._pending_edges:
            self._pending_edges.discard(edge_id)
        else:
            self._removed_edges.add(edge_id)

    def incident(self, node_id: int) -> list[int]:
        """Edges that end there, oldest first."""
        return sorted(self._incident.get(node_id, ()))

    def mark_moved(self, node_ids: Iterable[int]) -> None:
        """These lie elsewhere than the solver would think."""
        self._moved_nodes.update(node_ids)

    def remove_node(self, node_id: int) -> None:
        """A pose without edges goes."""
        self._incident.pop(node_id, None)
        self._moved_nodes.discard(node_id)
        if node_id in self._sent_nodes:
            self._sent_nodes.discard(node_id)
            self._removed_nodes.add(node_id)

    def take_update(self, poses: Mapping[int, F64], gravity_factors: Mapping[int, F64]) -> GraphUpdate:
        """All that the solver has not been told yet; it is taken as told. poses: of all numbers, as is
        plumb (`share.mapping.graph.edges`)."""
        edges = [(n, self.by_id[n], n in self.loops) for n in sorted(self._pending_edges)]
        update = GraphUpdate.from_edges(
            {node_id: poses[node_id] for node_id in sorted(self._moved_nodes)},
            edges,
            sorted(self._removed_edges),
            sorted(self._removed_nodes),
            gravity_factors,
        )
        self.is_reset = False
        self._sent_nodes |= self._moved_nodes
        for sent in (self._pending_edges, self._moved_nodes, self._removed_edges, self._removed_nodes):
            sent.clear()
        return update

    def reset(self) -> None:
        """The solver has lost everything."""
        self.is_reset = True
        self._pending_edges = set(self.by_id)
        self._moved_nodes |= self._sent_nodes
        for forgotten in (self._sent_nodes, self._removed_edges, self._removed_nodes):
            forgotten.clear()


def rescale_translation(T: F64, log_scale: float) -> F64:
    """T (4, 4) whose way was too long by this."""
    return se3.from_rt(T[:3, :3], T[:3, 3] * np.exp(-log_scale)) if log_scale else T


class MapGraph:
    """poses: T_map_body (4, 4) of every node, by its number. plumb: which way is up there, if it is known
    (`share.mapping.graph.edges`). founder: of the map of each stretch. parted: stretches that were left in
    another map when loops were taken back, since somebody last asked. scale: log of what each agent's
    odometry is shortened by; width: by what its variances are multiplied; nothing where it is not there."""

    def __init__(self) -> None:
        self.odometry = OdometrySegments()
        self.edges = GraphEdges()
        self.poses: dict[int, F64] = {}
        self.gravity_factors: dict[int, F64] = {}
        self.reference_segments: list[int] = []
        self.split_segments: set[int] = set()
        self.loop_counts: Counter[tuple[int, int]] = Counter()  # loops by the two stretches that they tie
        self.log_scales: dict[str, float] = {}
        self.covariance_scales: dict[str, float] = {}
        self.unsolved_maps: dict[int, None] = {}  # founders of maps with news, the oldest first

    def add_keyframe(
        self, agent: str, keyframe: Keyframe, cov: F64, gravity_factor: F64, rank: int = 0
    ) -> int:
        """The number of the new node. cov (6, 6): of its step from the one before, as it is believed; so is
        plumb (3,). rank: of a stretch that it begins."""
        node_id = self.odometry.add_keyframe(agent, keyframe, rank)
        self.add_node(node_id, keyframe.T_ref_body, cov, gravity_factor)
        return node_id

    def add_node(self, node_id: int, T_ref_body: F64, cov: F64, gravity_factor: F64) -> None:
        """Give a new node its pose, by odometry as its agent told it, and tie it to the one before it, if
        there is one."""
        node, previous = self.odometry.nodes[node_id], self.odometry.previous_node(node_id)
        agent = self.odometry.segments[node.segment].agent
        T_ref_body = rescale_translation(T_ref_body, self.log_scales.get(agent, 0.0))
        self.reference_segments += range(len(self.reference_segments), len(self.odometry.segments))
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

    def remove_node(self, node_id: int) -> None:
        """A node without edges goes."""
        self.edges.remove_node(node_id)
        self.odometry.remove_node(node_id)
        del self.poses[node_id]
        self.gravity_factors.pop(node_id, None)

    # ------------------------------------------------------------ changes

    def add_loop(self, loop: Loop) -> None:
        """Two maps that it ties are one from now on."""
        a, b = self.loop_nodes(loop)
        self.add_loop_edge(PoseEdge(a, b, loop.T_a_b, loop.cov), loop)
        if not self.is_same_map(a, b):
            self.update_maps()
        self.unsolved_maps = dict.fromkeys(
            [*(self.reference_segments[f] for f in self.unsolved_maps), self.reference_segment(loop.a)]
        )

    def add_loop_edge(self, edge: PoseEdge, loop: Loop) -> None:
        """A loop as an edge; if it ties what no other does, `update_maps` is due."""
        self.edges.add(edge, loop)
        self.loop_counts[self.segment_pair(edge)] += 1

    def remove_loop_edge(self, edge_id: int) -> None:
        """Take a loop's edge out; if it was the last of its bond, `update_maps` is due."""
        pair = self.segment_pair(self.edges.by_id[edge_id])
        self.loop_counts[pair] -= 1
        if not self.loop_counts[pair]:
            del self.loop_counts[pair]
        self.edges.remove(edge_id)

    def drop_loops(self, edge_ids: Sequence[int]) -> tuple[Loop, ...]:
        """Take loops, by their edges' numbers, back, and the joins that hung on them."""
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

    def align_maps(self, loop: Loop) -> None:
        """Of the two maps that it would tie, move that of the lesser founder rigidly to where it says."""
        if self.rank(self.reference_segment(loop.a)) > self.rank(self.reference_segment(loop.b)):
            loop = loop.reverse()
        a, b = self.loop_nodes(loop)
        self.move_map(self.reference_segment(loop.b), self.poses[a] @ loop.T_a_b @ se3.inverse(self.poses[b]))

    def move_map(self, reference_segment: int, T: F64) -> None:
        """The whole map, rigidly, by T (4, 4) from the left."""
        node_ids = self.map_nodes(reference_segment)
        moved = se3.orthonormal(T @ np.array([self.poses[n] for n in node_ids]))
        self.poses.update(zip(node_ids, moved, strict=True))
        self.edges.mark_moved(node_ids)

    def rescale_odometry(self, agent: str, log_scale: float, covariance_scale: float) -> None:
        """All odometry of this agent is to be shortened by log, and its variances multiplied by width; its
        maps are due."""
        log_change, covariance_ratio = (
            log_scale - self.log_scales.get(agent, 0.0),
            covariance_scale / self.covariance_scales.get(agent, 1.0),
        )
        self.log_scales[agent], self.covariance_scales[agent] = log_scale, covariance_scale
        for segment_index, segment in enumerate(self.odometry.segments):
            if segment.agent != agent or not segment.nodes:
                continue
            for before, after in itertools.pairwise(segment.nodes):
                edge_id, edge = self._find_odometry_edge(before, after)
                self.edges.remove(edge_id)
                self.edges.add(
                    replace(
                        edge,
                        T_a_b=rescale_translation(edge.T_a_b, log_change),
                        cov=covariance_ratio * edge.cov,
                    )
                )
            self.unsolved_maps.setdefault(self.reference_segments[segment_index])

    def propagate(self, node_ids: Iterable[int]) -> None:
        """These go where odometry takes them from the ones before them."""
        for node_id in node_ids:
            previous = self.odometry.previous_node(node_id)
            if previous is not None:
                T = self.poses[previous] @ self.odometry_edge(previous, node_id).T_a_b
                self.poses[node_id] = se3.orthonormal(T)

    # ------------------------------------------------------------ looking things up

    def loop_nodes(self, loop: Loop) -> tuple[int, int]:
        """The nodes of its keyframes. Raises ValueError if one is unknown."""
        return self.odometry.node_id(loop.a), self.odometry.node_id(loop.b)

    def odometry_edge(self, previous: int, node_id: int) -> PoseEdge:
        """The odometry edge from a node to the next of its stretch."""
        _, edge = self._find_odometry_edge(previous, node_id)
        return edge if edge.a == previous else edge.reverse()

    def _find_odometry_edge(self, previous: int, node_id: int) -> tuple[int, PoseEdge]:
        for edge_id in self.edges.incident(node_id):
            edge = self.edges.by_id[edge_id]
            if edge_id not in self.edges.loops and previous in (edge.a, edge.b):
                return edge_id, edge
        raise ValueError(f"odometry does not lead from node {previous} to {node_id}")

    def segment(self, key: KeyframeKey) -> int:
        return self.odometry.nodes[self.odometry.node_id(key)].segment

    def reference_segment(self, key: KeyframeKey) -> int:
        return self.reference_segments[self.segment(key)]

    def is_same_map(self, a: int, b: int) -> bool:
        segment_a, segment_b = self.odometry.nodes[a].segment, self.odometry.nodes[b].segment
        return self.reference_segments[segment_a] == self.reference_segments[segment_b]

    def map_id(self, segment: int) -> str:
        """Of the map that this stretch is in."""
        lost = segment >= len(
            self.reference_segments
        )  # of a damaged file that has none of its keyframes, nor later ones
        return self.odometry.segments[segment if lost else self.reference_segments[segment]].name

    def find_map(self, map_id: str) -> int:
        """The founder of a map. Raises ValueError if there is none of that name."""
        for reference_segment in {
            self.reference_segments[segment] for segment in self.odometry.live_segments
        }:
            if self.odometry.segments[reference_segment].name == map_id:
                return reference_segment
        raise ValueError(f"there is no map {map_id}")

    def rank(self, segment: int) -> tuple[int, int]:
        """Of the stretches of a map, the least founds it."""
        return self.odometry.segments[segment].rank, segment

    def map_segments(self, reference_segment: int) -> list[int]:
        """Those of a map that have keyframes, its founder first, if that has any."""
        return sorted(
            (s for s in self.odometry.live_segments if self.reference_segments[s] == reference_segment),
            key=self.rank,
        )

    def map_nodes(self, reference_segment: int) -> list[int]:
        return [n for s in self.map_segments(reference_segment) for n in self.odometry.segments[s].nodes]

    def anchor(self, reference_segment: int) -> int:
        """The keyframe that holds the gauge of a map."""
        return self.odometry.segments[reference_segment].nodes[0]

    def T_map_odom(self, node_id: int) -> F64:
        """T_map_odom (4, 4) as this node has it."""
        T_odom_body = self.odometry.nodes[node_id].T_odom_body
        return se3.orthonormal(self.poses[node_id] @ se3.inverse(T_odom_body))

    def relative_pose(self, a: int, b: int) -> F64:
        """T_a_b (4, 4) of two nodes of a map."""
        return se3.inverse(self.poses[a]) @ self.poses[b]

    def relative_estimates(self, a: int, goals: Sequence[int]) -> RelativePose:
        """Poses (N, 4, 4) of the goals in node a of the same map, as the map has them now."""
        covs = self.edges.covariance_paths.covariances_from(a, goals, self.poses)
        for goal, cov in zip(goals, covs, strict=True):
            if cov is None:
                raise ValueError(f"nodes {a} and {goal} are not in one map")
        return RelativePose(
            se3.inverse(self.poses[a]) @ np.array([self.poses[n] for n in goals]), np.array(covs)
        )

    def segment_pair(self, edge: PoseEdge) -> tuple[int, int]:
        """The stretches at its ends, the older first."""
        a, b = (self.odometry.nodes[end].segment for end in (edge.a, edge.b))
        return (a, b) if a < b else (b, a)

    def update_maps(self) -> None:
        """Every stretch's founder, from the loops: the connected parts."""
        root = list(range(len(self.reference_segments)))

        def find(i: int) -> int:
            while root[i] != i:
                i = root[i]
            return i

        for pair in self.loop_counts:
            low, high = sorted(map(find, pair), key=self.rank)
            root[high] = low
        self.reference_segments = [find(i) for i in range(len(root))]
