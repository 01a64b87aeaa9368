"""Odometry segments as the agents sent them, and the runs of each agent."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from share.mapping.loops import KeyframeKey
from share.types import F64, Keyframe

MIN_LOOP_GAP = 10  # keyframes of one segment closer than this make no loop


@dataclass(frozen=True, eq=False)
class Node:
    """A keyframe of a segment.

    T_odom_body (4, 4): its pose by the agent's odometry. ordinal: number of keyframes before it on the
    segment, removed ones included.
    """

    key: KeyframeKey
    segment: int
    ordinal: int
    T_odom_body: F64


@dataclass(eq=False)
class Segment:
    """A segment of one agent's odometry.

    nodes: node ids, ascending. name: `agent/n`, the n-th of this agent. rank: the segment of the least rank,
    among equals the oldest, is the reference of a map; even for headsets. total_count: keyframes it ever had.
    """

    agent: str
    name: str
    rank: int = 0
    nodes: list[int] = field(default_factory=list)
    total_count: int = 0

    @property
    def is_worn(self) -> bool:
        """Whether its agent is a headset, or served as one."""
        return self.rank % 2 == 0


class OdometrySegments:
    """Nodes by id, in order of arrival, and the segments that they form, oldest first.

    live_segments: those that still have nodes. changed_segments: that were added to them or removed since the
    reader (`MapGraph.maps`) cleared it.
    """

    def __init__(self) -> None:
        self.nodes: dict[int, Node] = {}
        self.segments: list[Segment] = []
        self.live_segments: dict[int, None] = {}
        self.changed_segments: list[int] = []
        self._live_counts = Counter[str]()  # live segments by agent
        self._next_id = 0
        self._node_ids: dict[KeyframeKey, int] = {}
        self._current: dict[str, int] = {}  # current segment of each agent
        self._segment_counts: dict[str, int] = {}  # segments of each agent so far

    def add_keyframe(self, agent: str, keyframe: Keyframe, rank: int = 0) -> int:
        """Add a keyframe and return its node id. rank: that of a segment which it begins.

        If all keyframes of the agent's current segment were removed, the keyframe continues it. Raises
        ValueError for a duplicate or an unknown reference: the caller applies each keyframe once and in
        order.
        """
        key = KeyframeKey(agent, keyframe.id)
        if key in self._node_ids:
            raise ValueError(f"keyframe {key} was added before")
        if keyframe.reference < 0:
            return self.append_node(key, self.new_segment(agent, rank), keyframe.T_odom_body)
        if (current := self._current.get(agent)) is not None and current not in self.live_segments:
            return self.append_node(key, current, keyframe.T_odom_body)
        previous = self.nodes[self.node_id(KeyframeKey(agent, keyframe.reference))]
        return self.append_node(key, previous.segment, keyframe.T_odom_body)

    def new_segment(self, agent: str, rank: int = 0) -> int:
        """Begin a segment, which becomes the agent's current one, and return its index."""
        count = self._segment_counts.get(agent, 0)
        self._segment_counts[agent] = count + 1
        self._current[agent] = len(self.segments)
        self.segments.append(Segment(agent, f"{agent}/{count}", rank))
        return len(self.segments) - 1

    def append_node(
        self, key: KeyframeKey, segment: int, T_odom_body: F64, ordinal: int | None = None
    ) -> int:
        """Append a node to a segment and return its id."""
        target = self.segments[segment]
        ordinal = target.total_count if ordinal is None else ordinal
        node_id, self._next_id = self._next_id, self._next_id + 1
        self.nodes[node_id] = Node(key, segment, ordinal, T_odom_body)
        target.nodes.append(node_id)
        if segment not in self.live_segments:
            self._mark_live(segment, True)
        target.total_count = ordinal + 1
        self._node_ids[key] = node_id
        return node_id

    def remove_node(self, node_id: int) -> None:
        """Remove a node; its segment continues without it."""
        node = self.nodes.pop(node_id)
        nodes = self.segments[node.segment].nodes
        nodes.remove(node_id)
        if not nodes:
            self._mark_live(node.segment, False)
        del self._node_ids[node.key]

    def _mark_live(self, segment: int, is_live: bool) -> None:
        self.changed_segments.append(segment)
        self._live_counts[self.segments[segment].agent] += 1 if is_live else -1
        if is_live:
            self.live_segments[segment] = None
        else:
            del self.live_segments[segment]

    def remove_agent(self, agent: str) -> None:
        """Forget an agent without nodes. Its segments keep their indices."""
        self._current.pop(agent, None)
        self._segment_counts.pop(agent, None)
        self._live_counts.pop(agent, None)

    def newest_node(self, agent: str) -> int | None:
        """Newest node of the agent's current segment, or None."""
        nodes = self.segments[self._current[agent]].nodes if agent in self._current else []
        return nodes[-1] if nodes else None

    def has_nodes(self, agent: str) -> bool:
        return self._live_counts[agent] > 0

    def has_keyframe(self, key: KeyframeKey) -> bool:
        return key in self._node_ids

    def node_id(self, key: KeyframeKey) -> int:
        """Return the node of a keyframe. Raises ValueError if it is unknown."""
        if key not in self._node_ids:
            raise ValueError(f"keyframe {key} is not known")
        return self._node_ids[key]

    def current_segment(self, agent: str) -> int | None:
        """The segment to which the agent's keyframes are appended; None before its first."""
        return self._current.get(agent)

    def previous_node(self, node_id: int) -> int | None:
        """Node before this one on its segment; None for the first."""
        return self._neighbour(node_id, -1)

    def next_node(self, node_id: int) -> int | None:
        """Node after this one on its segment; None for the newest."""
        return self._neighbour(node_id, +1)

    def are_neighbours(self, a: int, b: int) -> bool:
        """Return whether a and b are too close on one segment for a loop."""
        first, second = self.nodes[a], self.nodes[b]
        return first.segment == second.segment and abs(first.ordinal - second.ordinal) < MIN_LOOP_GAP

    def neighbours(self, node_id: int) -> tuple[int, ...]:
        """The node, and those too close to it on its segment for a loop."""
        nodes = self.segments[self.nodes[node_id].segment].nodes
        position = bisect_left(nodes, node_id)
        nearby = nodes[max(0, position - MIN_LOOP_GAP) : position + MIN_LOOP_GAP]
        return tuple(n for n in nearby if self.are_neighbours(n, node_id))

    def _neighbour(self, node_id: int, step: int) -> int | None:
        nodes = self.segments[self.nodes[node_id].segment].nodes
        i = bisect_left(nodes, node_id) + step
        return nodes[i] if 0 <= i < len(nodes) else None


# Runs of each agent: which are connected, and which is the current one of a name.


class AgentRuns:
    """Runs by agent name, and which runs are connected. An unregistered run is present under its own id."""

    def __init__(self) -> None:
        self._name_by_run: dict[str, str] = {}
        self._runs_by_name: dict[str, dict[str, None]] = {}  # in order of registration
        self._present: dict[str, None] = {}  # registered runs that are connected
        self._present_run: dict[str, str] = {}  # current run of each name, by when it last connected
        self._absent: set[str] = set()

    def add(self, run: str, name: str) -> None:
        """Register a new run, which becomes the current one of its name."""
        self._name_by_run[run] = name
        self._runs_by_name.setdefault(name, {})[run] = None
        self.set_present(run, True)

    def set_present(self, run: str, is_present: bool) -> bool:
        """Set whether a run is connected; return whether that changed.

        A run that reconnects becomes the current one of its name again.
        """
        was_absent = run in self._absent
        if not is_present:
            self._absent.add(run)
            self._present.pop(run, None)
            return not was_absent
        self._absent.discard(run)
        self._present[run] = None
        name = self.name(run)
        self._present_run.pop(name, None)
        self._present_run[name] = run
        return was_absent

    def remove(self, run: str) -> None:
        name = self._name_by_run.pop(run, run)
        self._absent.discard(run)
        self._present.pop(run, None)
        remaining = self._runs_by_name.get(name, {})
        remaining.pop(run, None)
        if self._present_run.get(name) == run:
            del self._present_run[name]
            if remaining:
                self._present_run[name] = next(reversed(remaining))
        if not remaining:
            self._runs_by_name.pop(name, None)

    def present(self) -> Iterable[str]:
        """Return the registered runs that are connected."""
        return self._present

    def name(self, run: str) -> str:
        return self._name_by_run.get(run, run)

    def is_absent(self, run: str) -> bool:
        return run in self._absent

    def is_name_absent(self, name: str) -> bool:
        """Return whether the current run of this name is not connected."""
        return self._present_run.get(name, name) in self._absent

    def is_superseded(self, run: str) -> bool:
        """Return whether the run is not connected and its name has a newer run."""
        return run in self._absent and self._present_run.get(self.name(run), run) != run

    def presence_order(self) -> dict[str, int]:
        """Rank of each name by when its current run last connected, oldest first."""
        return {name: i for i, name in enumerate(self._present_run)}
