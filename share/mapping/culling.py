"""Culling: which redundant keyframes to remove.

The keyframes that stay cover the same views, and keep most of the information of those removed
(`share.mapping.keyframe_removal`).

Quotas are per agent name, not per run: restarts gain nothing. All absent names together count as one name
beside those present. A name gives in this order: keyframes that resemble others in finished maps, the same in
ongoing maps, whole finished maps from the smallest, then the most redundant of the rest. A map is finished if
none of its agents is present and it has keyframes of one name only.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from enum import Enum, auto

import numpy as np

from share.geometry import se3
from share.mapping.loop_consistency import PLACE_M, PLACE_RAD, articulation_segments
from share.mapping.map_graph import MapGraph
from share.mapping.segments import MIN_LOOP_GAP, AgentRuns
from share.types import F64

_MARGIN = 1.05  # share of the most keyframes at which those to remove are chosen
_REMOVED_PER_KEYFRAME = 2
_BLOCK_ROWS = 256
_NO_NEIGHBOUR_DISTANCE = 1e9  # of a pose without others


def redundant(
    poses: F64, owners: Sequence[str | None], quotas: Counter[str], max_distance: float
) -> list[int]:
    """Select poses (N, 4, 4) to remove, by index, in order of removal.

    Repeatedly takes one of the closest pair, the one whose second neighbour is nearer, while the pair is
    closer than `max_distance`. Distance of two poses: |shift| / PLACE_M + angle / PLACE_RAD. owners: name of
    each pose; None: must stay. quotas: removals of each name; counted down.
    """
    distance = _pairwise_distance(poses)
    np.fill_diagonal(distance, np.inf)
    names = np.array([name or "" for name in owners])
    is_removable = np.array([name is not None and quotas[name] > 0 for name in owners], bool)
    two_nearest = np.concatenate([_two_nearest(distance[rows]) for rows in _row_blocks(len(poses))])
    out: list[int] = []
    while is_removable.any():
        rank = np.minimum(two_nearest[:, 0] + 1e-3 * two_nearest[:, 1], _NO_NEIGHBOUR_DISTANCE)
        removed = int(np.where(is_removable, rank, np.inf).argmin())
        if two_nearest[removed, 0] > max_distance:
            break
        out.append(removed)
        is_removable[removed] = False
        quotas[str(names[removed])] -= 1
        if not quotas[str(names[removed])]:
            is_removable[names == names[removed]] = False
        stale = np.flatnonzero(distance[removed] <= two_nearest[:, 1])
        distance[removed], distance[:, removed] = np.inf, np.inf
        two_nearest[stale] = _two_nearest(distance[stale])
    return out


def _pairwise_distance(poses: F64) -> F64:
    distance: F64 = np.empty((len(poses), len(poses)))
    for rows in _row_blocks(len(poses)):
        shift, angle = se3.pairwise_distances(poses[rows], poses)
        distance[rows] = shift / PLACE_M + angle / PLACE_RAD
    return distance


def _row_blocks(count: int) -> list[slice]:
    """Slices of rows: temporaries for all rows at once would take five times the result's memory."""
    return [slice(k, k + _BLOCK_ROWS) for k in range(0, count, _BLOCK_ROWS)]


def _two_nearest(distance: F64) -> F64:
    """Two least distances of each row, (N, 2); inf where missing."""
    if distance.shape[1] < 2:
        return np.full((len(distance), 2), np.inf)
    return np.partition(distance, 1, axis=1)[:, :2].copy()


_ABSENT_AGENTS = ""  # not a valid name
_SAME_PLACE_DISTANCE = 1.0  # in the measure of `redundant`


class ReturnReserve(Enum):
    """Keyframes kept for the return of absent agents, most first.

    NEWEST_AND_MAP: their newest keyframes and something of their map; MAP_ONLY: only the latter.
    """

    NEWEST_AND_MAP = auto()
    MAP_ONLY = auto()
    NOTHING = auto()


class KeyframeCulling:
    """Chooses the keyframes of one graph to remove."""

    def __init__(self, graph: MapGraph, runs: AgentRuns) -> None:
        self._graph, self._runs = graph, runs
        self._due: list[int] = []
        self._threshold = 0.0  # number of keyframes at which removable ones are searched for again

    def next_nodes(self, max_keyframes: int) -> list[int]:
        """Nodes to remove when a keyframe arrives: two at most, since all at once would delay the others."""
        count = len(self._graph.poses)
        if not self._due and count > max(max_keyframes * _MARGIN, self._threshold):
            self._due = self.choose(count - max_keyframes)
            # Where no keyframe is removable, do not search for one each time.
            self._threshold = 0.0 if self._due else count * _MARGIN
        batch, self._due = self._due[:_REMOVED_PER_KEYFRAME], self._due[_REMOVED_PER_KEYFRAME:]
        return batch

    def choose(self, count: int) -> list[int]:
        """Return up to `count` node ids to remove.

        If possible, absent runs keep their newest keyframes, and maps without a present agent keep something.
        """
        for reserve in ReturnReserve:
            if len(chosen := self._choose_with(count, reserve)) >= count:
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

    def _choose_with(self, count: int, reserve: ReturnReserve) -> list[int]:
        maps = self._segments_by_map()
        finished = [
            reference_segment
            for reference_segment, segments in maps.items()
            if self._is_finished(segments, reserve)
        ]
        ongoing = [reference_segment for reference_segment in maps if reference_segment not in set(finished)]
        protected = self._protected(ongoing, reserve)
        quotas, out = self._quotas(count, protected), dict[int, None]()
        for reference_segment in (*finished, *ongoing):
            self._add_redundant(maps[reference_segment], protected, quotas, out, _SAME_PLACE_DISTANCE)
        for reference_segment in (*reversed(finished), *ongoing):
            self._add_redundant(maps[reference_segment], protected, quotas, out)
        return list(out)

    def _add_redundant(
        self,
        segments: Sequence[int],
        protected: set[int],
        quotas: Counter[str],
        removed: dict[int, None],
        max_distance: float = np.inf,
    ) -> None:
        """Add redundant nodes of one map to `removed`, within the quotas, closer than `max_distance`."""
        graph = self._graph
        node_ids = [n for s in segments for n in graph.odometry.segments[s].nodes if n not in removed]
        owners = [None if n in protected else self._agent_name(n) for n in node_ids]
        if any(name is not None and quotas[name] for name in owners):
            poses = np.array([graph.poses[n] for n in node_ids])
            chosen = redundant(poses, owners, quotas, max_distance)
            removed |= dict.fromkeys(node_ids[i] for i in chosen)

    def _quotas(self, count: int, protected: set[int]) -> Counter[str]:
        """How many keyframes each name gives."""
        held_counts = Counter(map(self._agent_name, self._graph.poses))
        removable = Counter(self._agent_name(n) for n in self._graph.poses if n not in protected)
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

    def _protected(self, reference_segments: Iterable[int], reserve: ReturnReserve) -> set[int]:
        """Nodes that must stay: the newest of each growing segment, the anchors of these maps, and a node of
        each segment that connects a map.
        """
        graph, odometry = self._graph, self._graph.odometry
        out = {graph.anchor(reference_segment) for reference_segment in reference_segments}
        for segment in odometry.live_segments:
            if self._is_growing(segment, reserve):
                out.update(odometry.segments[segment].nodes[-MIN_LOOP_GAP:])
        for segment in articulation_segments(graph.loop_counts):
            nodes = odometry.segments[segment].nodes
            out.add(max(nodes, key=lambda n: len(graph.edges.incident(n))))
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

    def _agent_name(self, node_id: int) -> str:
        return self._runs.name(self._graph.odometry.nodes[node_id].key.agent)


def fair_quotas(
    counts: Counter[str], limits: Counter[str], count: int, presence_order: Mapping[str, int]
) -> Counter[str]:
    """Split `count` removals among names: one at a time from the name that holds most.

    Ties go to the name that connected longest ago. A name that holds no more than a fair share gives nothing.
    counts: keyframes of each name; limits: how many each can give; presence_order: from
    `AgentRuns.presence_order`.
    """
    out = Counter[str]()
    for _ in range(min(count, limits.total())):
        candidates = (name for name in counts if out[name] < limits[name])
        out[max(candidates, key=lambda name: (counts[name] - out[name], -presence_order.get(name, -1)))] += 1
    return out
