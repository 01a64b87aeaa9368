"""Revisits: keyframes of an agent that waits to enter another's map are looked up again.

Before the agent's map became part of another's, its keyframes were compared with those near them in its own
map. In the joined map other keyframes are near them. Loops with these localise the agent there sooner, and
they are far apart, so their errors are less correlated than those of the next keyframes' loops.
"""

from __future__ import annotations

from collections.abc import Iterable

from share.mapping.map_graph import MapGraph

_NEWEST = 12  # keyframes of a segment that are looked up again


class Revisits:
    """Remembers in which map each keyframe was looked up."""

    def __init__(self, graph: MapGraph) -> None:
        self._graph = graph
        self._looked_up_in: dict[int, int] = {}  # by node: reference segment of its map at that time

    def note_lookup(self, node_id: int) -> bool:
        """Note that a keyframe is looked up now. Return whether it was before."""
        is_revisit = node_id in self._looked_up_in
        segment = self._graph.odometry.nodes[node_id].segment
        self._looked_up_in[node_id] = self._graph.reference_segments[segment]
        return is_revisit

    def next_node(self, waiting_segments: Iterable[int]) -> int | None:
        """Return the newest keyframe of these segments that was looked up in another map, or None."""
        for segment in waiting_segments:
            reference_segment = self._graph.reference_segments[segment]
            for node_id in reversed(self._graph.odometry.segments[segment].nodes[-_NEWEST:]):
                if self._looked_up_in.get(node_id, reference_segment) != reference_segment:
                    return node_id
        return None

    def remove(self, node_id: int) -> None:
        """Forget a keyframe."""
        self._looked_up_in.pop(node_id, None)
