"""What the agents said of themselves: keyframes on stretches of unbroken odometry."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from share.mapping.loops import KeyframeKey
from share.types import F64, Keyframe


@dataclass(frozen=True, eq=False)
class Node:
    """A keyframe of a stretch. T_odom_body (4, 4): where its agent took itself to be. ordinal: how many
    came before it there."""

    key: KeyframeKey
    segment: int
    ordinal: int
    T_odom_body: F64


@dataclass(eq=False)
class Segment:
    """nodes: their numbers, rising. name: `agent/n`, the n-th of this agent. rank: of a map's stretches the
    least founds it, the oldest of those that are alike. count: of all it ever had."""

    agent: str
    name: str
    rank: int = 0
    nodes: list[int] = field(default_factory=list)
    total_count: int = 0


class OdometrySegments:
    """Nodes by number, in the order of arrival, and the stretches that they make up, oldest first; live:
    those that have nodes."""

    def __init__(self) -> None:
        self.nodes: dict[int, Node] = {}
        self.segments: list[Segment] = []
        self.live_segments: dict[int, None] = {}
        self._next_id = 0
        self._node_ids: dict[KeyframeKey, int] = {}
        self._current: dict[str, int] = {}  # agent -> stretch that it is on
        self._segment_counts: dict[str, int] = {}  # agent -> how many stretches

    def add_keyframe(self, agent: str, keyframe: Keyframe, rank: int = 0) -> int:
        """The number of the new node. rank: of a stretch that it begins. Where all of its stretch was taken
        out, that goes on with it. Raises ValueError for a keyframe known already, or one whose reference is
        unknown: the caller applies each once and in order."""
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
        """A new stretch of this agent, which is on it from now on."""
        count = self._segment_counts.get(agent, 0)
        self._segment_counts[agent] = count + 1
        self._current[agent] = len(self.segments)
        self.segments.append(Segment(agent, f"{agent}/{count}", rank))
        return len(self.segments) - 1

    def append_node(
        self, key: KeyframeKey, segment: int, T_odom_body: F64, ordinal: int | None = None
    ) -> int:
        """The number of a new node at the end of a stretch."""
        segment_record = self.segments[segment]
        node_id, self._next_id = self._next_id, self._next_id + 1
        self.nodes[node_id] = Node(
            key, segment, segment_record.total_count if ordinal is None else ordinal, T_odom_body
        )
        segment_record.nodes.append(node_id)
        self.live_segments[segment] = None
        segment_record.total_count = self.nodes[node_id].ordinal + 1
        self._node_ids[key] = node_id
        return node_id

    def remove_node(self, node_id: int) -> None:
        """Forget a node; its stretch goes on without it."""
        node = self.nodes.pop(node_id)
        nodes = self.segments[node.segment].nodes
        nodes.remove(node_id)
        if not nodes:
            del self.live_segments[node.segment]
        del self._node_ids[node.key]

    def remove_agent(self, agent: str) -> None:
        """An agent that has no nodes any more. Its stretches stay as numbers without any."""
        self._current.pop(agent, None)
        self._segment_counts.pop(agent, None)

    def newest_node(self, agent: str) -> int | None:
        """The newest node of the agent's present stretch."""
        nodes = self.segments[self._current[agent]].nodes if agent in self._current else []
        return nodes[-1] if nodes else None

    def has_nodes(self, agent: str) -> bool:
        """Whether a node of the agent is left, on any of its stretches."""
        return any(self.segments[segment].agent == agent for segment in self.live_segments)

    def has_keyframe(self, key: KeyframeKey) -> bool:
        return key in self._node_ids

    def node_id(self, key: KeyframeKey) -> int:
        """Raises ValueError if no such keyframe is there."""
        if key not in self._node_ids:
            raise ValueError(f"keyframe {key} is not known")
        return self._node_ids[key]

    def current_segment(self, agent: str) -> int | None:
        """The stretch that the agent is on now."""
        return self._current.get(agent)

    def previous_node(self, node_id: int) -> int | None:
        """The node before this one on its stretch; None for the first."""
        return self._neighbour(node_id, -1)

    def next_node(self, node_id: int) -> int | None:
        """The node after this one on its stretch; None for the newest."""
        return self._neighbour(node_id, +1)

    def are_neighbours(self, a: int, b: int, disagreement: int) -> bool:
        """Fewer than `disagreement` keyframes apart on one stretch, so that odometry knows their pose
        best."""
        first, second = self.nodes[a], self.nodes[b]
        return first.segment == second.segment and abs(first.ordinal - second.ordinal) < disagreement

    def _neighbour(self, node_id: int, step: int) -> int | None:
        nodes = self.segments[self.nodes[node_id].segment].nodes
        at = bisect_left(nodes, node_id) + step
        return nodes[at] if 0 <= at < len(nodes) else None


# ---- Whose each run is, and which run of a name is its present one.


class AgentRuns:
    """Runs by name. A run that nobody has introduced is its own name's, and present."""

    def __init__(self) -> None:
        self._name_by_run: dict[str, str] = {}
        self._present_run: dict[str, str] = {}  # run of each name, the one heard of longest ago first
        self._absent: set[str] = set()

    def add(self, run: str, name: str) -> None:
        """A new run: it is its name's present one from now on."""
        self._name_by_run[run] = name
        self.set_present(run, True)

    def set_present(self, run: str, is_present: bool) -> bool:
        """Whether it is heard; returns whether that is news. An older run that comes back is its name's
        present one again."""
        was_absent = run in self._absent
        if not is_present:
            self._absent.add(run)
            return not was_absent
        self._absent.discard(run)
        name = self.name(run)
        self._present_run.pop(name, None)
        self._present_run[name] = run
        return was_absent

    def remove(self, run: str) -> None:
        """Nothing of it is left."""
        name = self._name_by_run.pop(run, run)
        self._absent.discard(run)
        if self._present_run.get(name) == run:
            del self._present_run[name]
            if remaining := [one for one in self._name_by_run if self._name_by_run[one] == name]:
                self._present_run[name] = remaining[-1]

    def name(self, run: str) -> str:
        return self._name_by_run.get(run, run)

    def is_absent(self, run: str) -> bool:
        return run in self._absent

    def is_name_absent(self, name: str) -> bool:
        """Whether none of its runs is heard."""
        return self._present_run.get(name, name) in self._absent

    def is_superseded(self, run: str) -> bool:
        """Whether it is not heard, and another run of its name has come after it."""
        return run in self._absent and self._present_run.get(self.name(run), run) != run

    def presence_order(self) -> dict[str, int]:
        """Of each name, when its present run came or came back: in the order of these numbers."""
        return {name: at for at, name in enumerate(self._present_run)}


def fair_quotas(
    counts: Counter[str], limits: Counter[str], count: int, presence_order: Mapping[str, int]
) -> Counter[str]:
    """How many of `total_count` each name gives: again and again the one that holds most, of several the one
    heard of longest ago. So nobody who holds no more than a fair share gives anything.

    held: keyframes of each name. most: that it can give. heard_of: as `Owners.presence_order`.
    """
    out = Counter[str]()
    for _ in range(min(count, limits.total())):
        candidates = (name for name in counts if out[name] < limits[name])
        out[max(candidates, key=lambda one: (counts[one] - out[one], -presence_order.get(one, -1)))] += 1
    return out
