"""Edges of the map graph, and what of them the solver has not received yet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from share.mapping.graph.covariance import CovariancePaths
from share.mapping.graph.edges import PoseEdge
from share.mapping.graph.solver import GraphUpdate
from share.mapping.loops import Loop
from share.mapping.pose_table import PoseTable
from share.types import F64


class GraphEdges:
    """Odometry and loop edges between node ids, and what of them the solver has not received yet."""

    def __init__(self) -> None:
        self.covariance_paths = CovariancePaths()
        self.by_id: dict[int, PoseEdge] = {}
        self.loops: dict[int, Loop] = {}  # by edge id, oldest first
        self.spans: set[int] = set()  # edge ids of odometry over several keyframes
        self._incident: dict[int, set[int]] = {}
        self._next_id = 0
        self.is_reset = True  # the next update contains the whole graph
        self._sent_nodes: set[int] = set()  # nodes that the solver has
        # Not sent to the solver yet:
        self._pending_edges: set[int] = set()
        self._moved_nodes: set[int] = set()  # new or moved
        self._removed_edges: set[int] = set()
        self._removed_nodes: set[int] = set()

    def add(self, edge: PoseEdge, loop: Loop | None = None) -> int:
        """Add an edge and return its id. With a loop, the solver treats it as a possible outlier."""
        edge_id, self._next_id = self._next_id, self._next_id + 1
        self.by_id[edge_id] = edge
        self._pending_edges.add(edge_id)
        if loop is not None:
            self.loops[edge_id] = loop
        for end in (edge.a, edge.b):
            self._incident.setdefault(end, set()).add(edge_id)
        self.covariance_paths.add(edge)
        return edge_id

    def add_span(self, edge: PoseEdge) -> None:
        """Add an odometry edge over several keyframes, beside those between neighbours."""
        self.spans.add(self.add(edge))

    def remove(self, edge_id: int) -> None:
        """Remove an edge, and its loop if it has one."""
        edge = self.by_id.pop(edge_id)
        self.spans.discard(edge_id)
        self.loops.pop(edge_id, None)
        for end in (edge.a, edge.b):
            self._incident[end].discard(edge_id)
        self.covariance_paths.remove(edge)
        if edge_id in self._pending_edges:
            self._pending_edges.discard(edge_id)
        else:
            self._removed_edges.add(edge_id)

    def incident(self, node_id: int) -> list[int]:
        """Ids of the edges that end at a node, oldest first."""
        return sorted(self._incident.get(node_id, ()))

    def degree(self, node_id: int) -> int:
        """Number of edges that end at a node."""
        return len(self._incident.get(node_id, ()))

    def mark_moved(self, node_ids: Iterable[int]) -> None:
        """Mark nodes whose poses differ from the solver's."""
        self._moved_nodes.update(node_ids)

    def remove_node(self, node_id: int) -> None:
        """Remove a node that has no edges."""
        self._incident.pop(node_id, None)
        self._moved_nodes.discard(node_id)
        if node_id in self._sent_nodes:
            self._sent_nodes.discard(node_id)
            self._removed_nodes.add(node_id)

    def take_update(self, poses: PoseTable, gravity_factors: Mapping[int, F64]) -> GraphUpdate:
        """Return all changes since the last call and count them as sent.

        poses, gravity_factors: of all node ids (`share.mapping.graph.gravity`).
        """
        edges = [(n, self.by_id[n], n in self.loops or n in self.spans) for n in sorted(self._pending_edges)]
        moved = sorted(self._moved_nodes)
        update = GraphUpdate.from_edges(
            dict(zip(moved, poses.stack(moved), strict=True)),
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
        """Count everything as not sent: the solver lost its state."""
        self.is_reset = True
        self._pending_edges = set(self.by_id)
        self._moved_nodes |= self._sent_nodes
        for forgotten in (self._sent_nodes, self._removed_edges, self._removed_nodes):
            forgotten.clear()
