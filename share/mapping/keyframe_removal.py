"""Removal of a keyframe from the map graph, and the odometry edge to a keyframe whose reference is gone.

Of the odometry a - x - b one edge a - b stays when x is removed; loops at x move to its neighbour along the
more certain of the two edges. That edge e then enters several edges: every moved loop, and a - b. Each gets a
share of its information and the shares sum to one, so nothing is counted twice, as if x were split into
unconnected copies; omitting connections is conservative. Source of the idea: covariance intersection; Julier
and Uhlmann, *A Non-divergent Estimation Algorithm*, ACC 1997.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.geometry import se3
from share.mapping.graph.edges import PoseEdge
from share.mapping.loops import KeyframeKey, Loop
from share.mapping.map_changes import MapChange, RemoveKeyframes, SaveLink, SaveLoop
from share.mapping.map_graph import MapGraph
from share.types import F64, Keyframe

MAX_LOOPS = 10  # loops of a keyframe that loops of removed keyframes may be moved to
_ODOMETRY_SHARE = 0.5  # of the information along which others move; loops share the rest equally


@dataclass(frozen=True, eq=False)
class RemovedKeyframe:
    """A removed keyframe, the edge that now leads to the next one, and its loops at their new ends."""

    node_id: int
    key: KeyframeKey
    link: SaveLink | None
    moved_loops: tuple[Loop, ...]

    @property
    def changes(self) -> list[MapChange]:
        """Changes to store, in order: the link may lead to a keyframe that is removed next."""
        links = [] if self.link is None else [self.link]
        return [*links, RemoveKeyframes((self.key,)), *map(SaveLoop, self.moved_loops)]


def remove_keyframe(graph: MapGraph, node_id: int) -> RemovedKeyframe:
    """Remove a keyframe and move its odometry and loops to a neighbour on its segment.

    Without such a neighbour its loops are removed. No keyframe receives more than `MAX_LOOPS` loops, except
    the last loop between two segments. Call `graph.update_maps` afterwards.
    """
    segments, edges = graph.odometry, graph.edges
    key = segments.nodes[node_id].key
    previous, following = segments.previous_node(node_id), segments.next_node(node_id)
    incident = edges.incident(node_id)
    loops = [(edges.loops[n], edges.by_id[n]) for n in incident if n in edges.loops]
    odometry_edges = [edges.by_id[n] for n in incident if n not in edges.loops and n not in edges.spans]
    for n in incident:
        if n in edges.loops:
            graph.remove_loop_edge(n)
        else:
            edges.remove(n)
    graph.remove_node(node_id)
    if not odometry_edges:
        return RemovedKeyframe(node_id, key, None, ())
    odometry, moved_edges = contract_pose(node_id, odometry_edges, [edge for _, edge in loops])
    for edge in odometry:
        edges.add(edge)
    link = None if following is None else _current_link(graph, previous, following)
    moving = [(old, edge) for (old, _), edge in zip(loops, moved_edges, strict=True) if edge is not None]
    moved_loops = [_move_loop(graph, old, edge) for old, edge in moving]
    return RemovedKeyframe(node_id, key, link, tuple(loop for loop in moved_loops if loop is not None))


def remove_segment(graph: MapGraph, segment: int) -> list[RemovedKeyframe]:
    """Remove all keyframes of a segment, with odometry and loops. Call `graph.update_maps` afterwards."""
    edges, out = graph.edges, list[RemovedKeyframe]()
    for node_id in list(graph.odometry.segments[segment].nodes):
        for n in edges.incident(node_id):
            if n in edges.loops:
                graph.remove_loop_edge(n)
            else:
                edges.remove(n)
        out.append(RemovedKeyframe(node_id, graph.odometry.nodes[node_id].key, None, ()))
        graph.remove_node(node_id)
    return out


def _current_link(graph: MapGraph, previous: int | None, node_id: int) -> SaveLink:
    """Odometry edge to a node from the node before it, if any."""
    node = graph.odometry.nodes[node_id]
    if previous is None:
        return SaveLink(node.key, -1, node.T_odom_body, np.zeros((6, 6)))
    edge = graph.odometry_edge(previous, node_id)
    return SaveLink(node.key, graph.odometry.nodes[previous].key.id, edge.T_a_b, edge.cov)


def _move_loop(graph: MapGraph, old: Loop, edge: PoseEdge) -> Loop | None:
    """Add the loop at its new ends; return None where they have one already, or enough."""
    edges, nodes = graph.edges, graph.odometry.nodes
    loops_at_a, loops_at_b = (
        {n for n in edges.incident(end) if n in edges.loops} for end in (edge.a, edge.b)
    )
    if loops_at_a & loops_at_b or (
        max(len(loops_at_a), len(loops_at_b)) >= MAX_LOOPS and graph.loop_counts[graph.segment_pair(edge)]
    ):
        return None
    loop = Loop(nodes[edge.a].key, nodes[edge.b].key, edge.T_a_b, edge.cov, old.inliers, old.found_share)
    graph.add_loop_edge(edge, loop)
    return loop


def contract_pose(
    pose: int, odometry: Sequence[PoseEdge], loops: Sequence[PoseEdge]
) -> tuple[list[PoseEdge], list[PoseEdge | None]]:
    """Return the edges that replace all `odometry` and `loops` edges at `pose`.

    Of odometry: all but the one along which the others moved, so none at the end of a chain. Of loops: one
    for each, None where both ends would be the same pose. Raises ValueError if the pose has no odometry
    edge, or if an edge does not end at it.
    """
    unrelated = [edge for edge in (*odometry, *loops) if pose not in (edge.a, edge.b)]
    if unrelated or not odometry:
        raise ValueError(
            f"pose {pose}: {'an edge does not end at it' if unrelated else 'it has no odometry edge'}"
        )
    path_edge = min(odometry, key=lambda edge: edge.cov_trace)
    neighbour = path_edge.a if path_edge.b == pose else path_edge.b
    others = [edge for edge in odometry if edge is not path_edge and neighbour not in (edge.a, edge.b)]
    is_moving = [neighbour not in (edge.a, edge.b) for edge in loops]
    to_odometry = (_ODOMETRY_SHARE if any(is_moving) else 1.0) / max(1, len(others))
    to_loops = (1 - _ODOMETRY_SHARE if others else 1.0) / max(1, sum(is_moving))
    return [_move_end(edge, pose, neighbour, path_edge, to_odometry) for edge in others], [
        _move_end(edge, pose, neighbour, path_edge, to_loops) if moves else None
        for edge, moves in zip(loops, is_moving, strict=True)
    ]


def _move_end(edge: PoseEdge, old_end: int, new_end: int, path_edge: PoseEdge, share: float) -> PoseEdge:
    """Move an end of `edge` along `path_edge`, with `share` of the latter's information."""
    oriented_path = path_edge if path_edge.a == old_end else path_edge.reverse()
    incoming = edge if edge.b == old_end else edge.reverse()
    cov = se3.compose_cov(oriented_path.T_a_b, incoming.cov, oriented_path.cov / share)
    result = PoseEdge(incoming.a, new_end, se3.orthonormal(incoming.T_a_b @ oriented_path.T_a_b), cov)
    return result if edge.b == old_end else result.reverse()


def reconnect(agent: str, keyframe: Keyframe, previous: tuple[int, F64] | None) -> SaveLink:
    """Odometry edge to a keyframe whose reference is gone, from an earlier one of its segment, if any.

    previous: id and T_odom_body (4, 4) of that one. Both are in one odometry frame, so their relative pose is
    T_odom_previous^-1 T_odom_body. The covariances of the steps between are gone; each is given that of the
    known step.
    """
    key = KeyframeKey(agent, keyframe.id)
    if previous is None:
        return SaveLink(key, -1, keyframe.T_odom_body, keyframe.cov)
    previous_id, T_odom_previous = previous
    lost_steps = max(1, keyframe.reference - previous_id)
    cov: F64 = se3.compose_cov(keyframe.T_ref_body, lost_steps * keyframe.cov, keyframe.cov)
    T = se3.orthonormal(se3.inverse(T_odom_previous) @ keyframe.T_odom_body)
    return SaveLink(key, previous_id, T, (cov + cov.T) / 2)
