"""Culling: which redundant keyframes to remove.

The keyframes that stay cover the same views, and keep most of the information of those removed
(`share.mapping.keyframe_removal`).

Quotas are per agent name, not per run, so restarts gain nothing. All absent names together count as one name
beside those present. Keyframes of a name are removed in this order: those that resemble others in finished
maps, those that do in ongoing maps, whole finished maps from the smallest, then the most redundant of the
rest. A map is finished if none of its agents is present and all its keyframes are of one name.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from enum import Enum, auto

import numpy as np

from share.mapping.agent_runs import AgentRuns
from share.mapping.loop_consistency import articulation_segments
from share.mapping.map_graph import MapGraph
from share.mapping.redundancy import InSlices, redundant, run_without_pause
from share.mapping.segments import MIN_LOOP_GAP

_MARGIN = 1.05  # share of the most keyframes at which those to remove are chosen
_REMOVED_PER_KEYFRAME = 2
_COST_PER_KEYFRAME = 1000  # of choosing, in the unit of `InSlices`: 10 ms
_ABSENT_AGENTS = ""  # not a valid name
_SAME_PLACE_DISTANCE = 1.0  # in the measure of `redundant`


class ReturnReserve(Enum):
    """What is kept for the return of absent agents; the search tries to keep most first.

    NEWEST_AND_MAP: their newest keyframes and a part of their map. MAP_ONLY: only the latter.
    """

    NEWEST_AND_MAP = auto()
    MAP_ONLY = auto()
    NOTHING = auto()


class KeyframeCulling:
    """Chooses the keyframes of one graph to remove."""

    def __init__(self, graph: MapGraph, runs: AgentRuns) -> None:
        self._graph, self._runs = graph, runs
        self._due: list[int] = []
        self._search: InSlices[list[int]] | None = None
        self._threshold = 0.0  # number of keyframes at which removable ones are searched for again

    def next_nodes(self, max_keyframes: int) -> list[int]:
        """Nodes to remove when a keyframe arrives: two at most, since all at once would delay the others.

        They are chosen in slices, one a call.
        """
        count = len(self._graph.poses)
        if self._search is None and not self._due and count > max(max_keyframes * _MARGIN, self._threshold):
            self._search = self._choose(count - max_keyframes)
        if self._search is not None:
            self._continue_search(self._search)
        batch, self._due = self._due[:_REMOVED_PER_KEYFRAME], self._due[_REMOVED_PER_KEYFRAME:]
        return batch

    def start_over(self) -> None:
        """Forget what was chosen: keyframes were removed otherwise."""
        self._search, self._due = None, []

    def _continue_search(self, search: InSlices[list[int]]) -> None:
        cost = 0
        try:
            while cost < _COST_PER_KEYFRAME:
                cost += next(search)
        except StopIteration as end:
            self._search, self._due = None, end.value
            # Where no keyframe is removable, do not search for one each time.
            self._threshold = 0.0 if self._due else len(self._graph.poses) * _MARGIN

    def choose(self, count: int) -> list[int]:
        """Return up to `count` node ids to remove.

        If possible, absent runs keep their newest keyframes, and maps without a present agent keep something.
        """
        return run_without_pause(self._choose(count))

    def _choose(self, count: int) -> InSlices[list[int]]:
        chosen: list[int] = []
        for reserve in ReturnReserve:
            chosen = yield from self._choose_with(count, reserve)
            if len(chosen) >= count:
                break
        return chosen

    def is_removable(self, node_id: int) -> bool:
        """Return whether a keyframe can be removed now."""
        graph = self._graph
        segment = graph.odometry.nodes[node_id].segment
        nodes, reference_segment = graph.odometry.segments[segment].nodes, graph.reference_segments[segment]
        if self._is_growing(segment, ReturnReserve.NOTHING) and node_id in nodes[-MIN_LOOP_GAP:]:
            return False
        if self._is_finished(graph.map_segments(reference_segment), ReturnReserve.NOTHING):
            return True
        return node_id != graph.anchor(reference_segment) and (
            len(nodes) > 1 or segment not in articulation_segments(graph.loop_counts)
        )

    def _choose_with(self, count: int, reserve: ReturnReserve) -> InSlices[list[int]]:
        maps = self._segments_by_map()
        finished = dict.fromkeys(one for one in maps if self._is_finished(maps[one], reserve))
        ongoing = [one for one in maps if one not in finished]
        protected = yield from self._protected(ongoing, reserve)
        quotas, out = self._quotas(count, protected), dict[int, None]()
        for reference in (*finished, *ongoing):
            yield from self._add_redundant(maps[reference], protected, quotas, out, _SAME_PLACE_DISTANCE)
        for reference in (*reversed(finished), *ongoing):
            yield from self._add_redundant(maps[reference], protected, quotas, out)
        return list(out)

    def _add_redundant(
        self,
        segments: Sequence[int],
        protected: set[int],
        quotas: Counter[str],
        removed: dict[int, None],
        max_distance: float = np.inf,
    ) -> InSlices[None]:
        """Add redundant nodes of one map to `removed`, within the quotas, closer than `max_distance`."""
        if not any(quotas[self._segment_name(s)] for s in segments):
            return
        graph, node_ids, owners = self._graph, list[int](), list[str | None]()
        for segment in segments:
            name = self._segment_name(segment)
            nodes = [n for n in graph.odometry.segments[segment].nodes if n not in removed]
            node_ids += nodes
            owners += [None if n in protected else name for n in nodes]
        chosen = yield from redundant(graph.poses.stack(node_ids), owners, quotas, max_distance)
        removed |= dict.fromkeys(node_ids[i] for i in chosen)

    def _quotas(self, count: int, protected: set[int]) -> Counter[str]:
        """How many keyframes of each name are to be removed."""
        held_counts = Counter[str]()
        for segment in self._graph.odometry.live_segments:
            held_counts[self._segment_name(segment)] += self._segment_size(segment)
        removable = held_counts - Counter(self._agent_name(n) for n in protected if n in self._graph.poses)
        runs, presence_order = self._runs, self._runs.presence_order()
        absent_names = {name for name in held_counts if runs.is_name_absent(name)}
        fair_share = (
            (held_counts.total() - count) // (len(held_counts.keys() - absent_names) + 1)
            if absent_names
            else 0
        )
        for name in held_counts.keys() - absent_names:
            removable[name] = min(removable[name], max(0, held_counts[name] - fair_share))

        def merge_absent(counts: Counter[str]) -> Counter[str]:
            here = Counter({name: n for name, n in counts.items() if name not in absent_names})
            here[_ABSENT_AGENTS] = sum(counts[name] for name in absent_names)
            return here

        out = fair_quotas(merge_absent(held_counts), merge_absent(removable), count, presence_order)
        held_counts, removable = (
            Counter({name: counts[name] for name in absent_names}) for counts in (held_counts, removable)
        )
        return out + fair_quotas(held_counts, removable, out.pop(_ABSENT_AGENTS, 0), presence_order)

    def _protected(self, reference_segments: Iterable[int], reserve: ReturnReserve) -> InSlices[set[int]]:
        """Nodes that must stay: the newest of each growing segment, the anchors of these maps, and a node of
        each segment that connects a map.
        """
        graph, odometry = self._graph, self._graph.odometry
        out = {graph.anchor(reference_segment) for reference_segment in reference_segments}
        for segment in odometry.live_segments:
            if self._is_growing(segment, reserve):
                out.update(odometry.segments[segment].nodes[-MIN_LOOP_GAP:])
        for segment in articulation_segments(graph.loop_counts):
            if nodes := odometry.segments[segment].nodes:
                out.add(max(nodes, key=graph.edges.degree))
            yield len(nodes) // 16
        return out

    def _segments_by_map(self) -> dict[int, list[int]]:
        """Segments by reference segment of their map, the largest map first, among equals the newest."""
        graph, maps = self._graph, dict[int, list[int]]()
        for segment in sorted(graph.odometry.live_segments, reverse=True):
            maps.setdefault(graph.reference_segments[segment], []).append(segment)
        return dict(sorted(maps.items(), key=lambda item: -sum(map(self._segment_size, item[1]))))

    def _segment_size(self, segment: int) -> int:
        return len(self._graph.odometry.segments[segment].nodes)

    def _is_finished(self, segments: Sequence[int], reserve: ReturnReserve) -> bool:
        """Return whether no segment of the map grows and all are of one name."""
        agents = {self._graph.odometry.segments[s].agent for s in segments}
        if reserve is ReturnReserve.MAP_ONLY:
            reserve = ReturnReserve.NEWEST_AND_MAP
        has_one_name = reserve is ReturnReserve.NOTHING or len(set(map(self._runs.name, agents))) == 1
        return has_one_name and not any(self._is_growing(s, reserve) for s in segments)

    def _is_growing(self, segment: int, reserve: ReturnReserve) -> bool:
        """Return whether the segment gets keyframes, or may once its agent returns."""
        agent, runs = self._graph.odometry.segments[segment].agent, self._runs
        is_gone = runs.is_superseded if reserve is ReturnReserve.NEWEST_AND_MAP else runs.is_absent
        return not is_gone(agent) and self._graph.odometry.current_segment(agent) == segment

    def _segment_name(self, segment: int) -> str:
        """Name of the agent of a segment."""
        return self._runs.name(self._graph.odometry.segments[segment].agent)

    def _agent_name(self, node_id: int) -> str:
        return self._runs.name(self._graph.odometry.nodes[node_id].key.agent)


def fair_quotas(
    counts: Counter[str], limits: Counter[str], count: int, presence_order: Mapping[str, int]
) -> Counter[str]:
    """Split `count` removals among names: one at a time from the name with most keyframes.

    Of equals, from the name that connected longest ago. A name with no more than a fair share loses nothing.
    counts: keyframes of each name; limits: how many each can give; presence_order: from
    `AgentRuns.presence_order`.
    """
    out = Counter[str]()
    heap = [(-counts[name], presence_order.get(name, -1), name) for name in counts if limits[name] > 0]
    heapq.heapify(heap)
    for _ in range(min(count, limits.total())):
        held, order, name = heapq.heappop(heap)
        out[name] += 1
        if out[name] < limits[name]:
            heapq.heappush(heap, (held + 1, order, name))
    return out
