"""Odometry segments as the agents sent them, and their ranks."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field

from share.config import Config
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import StoredMap
from share.scheduling.qoe import QoeParameters
from share.types import F64, AgentKind, Keyframe
from share.wire.messages import Hello

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

    live_segments: those that still have nodes. by_name: the newest segment of each name.
    """

    def __init__(self) -> None:
        self.nodes: dict[int, Node] = {}
        self.segments: list[Segment] = []
        self.live_segments: dict[int, None] = {}
        self.by_name: dict[str, int] = {}
        self._live_of_agent: dict[str, dict[int, None]] = {}
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
        segment = Segment(agent, f"{agent}/{count}", rank)
        self._current[agent] = self.by_name[segment.name] = len(self.segments)
        self.segments.append(segment)
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
        self.live_segments[segment] = self._live_of_agent.setdefault(target.agent, {})[segment] = None
        target.total_count = ordinal + 1
        self._node_ids[key] = node_id
        return node_id

    def remove_node(self, node_id: int) -> None:
        """Remove a node; its segment continues without it."""
        node = self.nodes.pop(node_id)
        segment = self.segments[node.segment]
        segment.nodes.remove(node_id)
        if not segment.nodes:
            del self.live_segments[node.segment], self._live_of_agent[segment.agent][node.segment]
        del self._node_ids[node.key]

    def remove_agent(self, agent: str) -> None:
        """Forget an agent without nodes. Its segments keep their indices."""
        self._current.pop(agent, None)
        self._segment_counts.pop(agent, None)
        self._live_of_agent.pop(agent, None)

    def newest_node(self, agent: str) -> int | None:
        """Newest node of the agent's current segment, or None."""
        nodes = self.segments[self._current[agent]].nodes if agent in self._current else []
        return nodes[-1] if nodes else None

    def has_nodes(self, agent: str) -> bool:
        return bool(self._live_of_agent.get(agent))

    def live_segments_of(self, agent: str) -> list[int]:
        """Return the agent's segments that still have nodes, oldest first."""
        return sorted(self._live_of_agent.get(agent, ()))

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


def segment_rank(config: Config, hello: Hello | None, is_reference: bool = False) -> int:
    """Rank of a new segment: in a merge the map of the lower rank stays. Even ranks are headsets'.

    Headsets' maps stay because their wearers would notice a jump; restored maps come before new ones. hello:
    None if missing in a damaged file.
    """
    form = None if hello is None else QoeParameters.from_config(config.control, hello.kind, hello.name).form
    return (0 if form is AgentKind.AR else 1) + (0 if is_reference else 2)


def restored_ranks(config: Config, stored: StoredMap) -> list[int]:
    """Rank of each segment of a restored map. Restored maps keep their reference segments."""
    references = set[str]() if stored.poses is None else set(stored.poses.map_ids)
    hellos = {run.run_key: run.hello for run in stored.runs}  # a damaged file may lack a segment's run
    return [
        segment_rank(config, hellos.get(name.rpartition("/")[0]), is_reference=name in references)
        for name in stored.segments
    ]
