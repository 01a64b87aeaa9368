"""What the agents said of themselves: keyframes on stretches of unbroken odometry."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from share.mapping.loops import Key
from share.types import F64, Keyframe


@dataclass(frozen=True, eq=False)
class Node:
    """A keyframe of a stretch. T_odom_body (4, 4): where its agent took itself to be. ordinal: how many
    came before it there."""

    key: Key
    stretch: int
    ordinal: int
    T_odom_body: F64


@dataclass(eq=False)
class Stretch:
    """nodes: their numbers, rising. name: `agent/n`, the n-th of this agent. rank: of a map's stretches the
    least founds it, the oldest of those that are alike. count: of all it ever had."""

    agent: str
    name: str
    rank: int = 0
    nodes: list[int] = field(default_factory=list)
    count: int = 0


class Trails:
    """Nodes by number, in the order of arrival, and the stretches that they make up, oldest first; live:
    those that have nodes."""

    def __init__(self) -> None:
        self.nodes: dict[int, Node] = {}
        self.stretches: list[Stretch] = []
        self.live: dict[int, None] = {}
        self._next = 0
        self._at: dict[Key, int] = {}
        self._current: dict[str, int] = {}  # agent -> stretch that it is on
        self._begun: dict[str, int] = {}  # agent -> how many stretches

    def add(self, agent: str, keyframe: Keyframe, rank: int = 0) -> int:
        """The number of the new node. rank: of a stretch that it begins. Where all of its stretch was taken
        out, that goes on with it. Raises ValueError for a keyframe known already, or one whose reference is
        unknown: the caller applies each once and in order."""
        key = Key(agent, keyframe.id)
        if key in self._at:
            raise ValueError(f"keyframe {key} was added before")
        if keyframe.reference < 0:
            return self.put(key, self.begin(agent, rank), keyframe.T_odom_body)
        if (current := self._current.get(agent)) is not None and current not in self.live:
            return self.put(key, current, keyframe.T_odom_body)
        before = self.nodes[self.number(Key(agent, keyframe.reference))]
        return self.put(key, before.stretch, keyframe.T_odom_body)

    def begin(self, agent: str, rank: int = 0) -> int:
        """A new stretch of this agent, which is on it from now on."""
        count = self._begun.get(agent, 0)
        self._begun[agent] = count + 1
        self._current[agent] = len(self.stretches)
        self.stretches.append(Stretch(agent, f"{agent}/{count}", rank))
        return len(self.stretches) - 1

    def put(self, key: Key, stretch: int, T_odom_body: F64, ordinal: int | None = None) -> int:
        """The number of a new node at the end of a stretch."""
        at = self.stretches[stretch]
        number, self._next = self._next, self._next + 1
        self.nodes[number] = Node(key, stretch, at.count if ordinal is None else ordinal, T_odom_body)
        at.nodes.append(number)
        self.live[stretch] = None
        at.count = self.nodes[number].ordinal + 1
        self._at[key] = number
        return number

    def take_out(self, number: int) -> None:
        """Forget a node; its stretch goes on without it."""
        node = self.nodes.pop(number)
        nodes = self.stretches[node.stretch].nodes
        nodes.remove(number)
        if not nodes:
            del self.live[node.stretch]
        del self._at[node.key]

    def forget(self, agent: str) -> None:
        """An agent that has no nodes any more. Its stretches stay as numbers without any."""
        self._current.pop(agent, None)
        self._begun.pop(agent, None)

    def newest(self, agent: str) -> int | None:
        """The newest node of the agent's present stretch."""
        nodes = self.stretches[self._current[agent]].nodes if agent in self._current else []
        return nodes[-1] if nodes else None

    def has_any(self, agent: str) -> bool:
        """Whether a node of the agent is left, on any of its stretches."""
        return any(self.stretches[number].agent == agent for number in self.live)

    def has(self, key: Key) -> bool:
        return key in self._at

    def number(self, key: Key) -> int:
        """Raises ValueError if no such keyframe is there."""
        if key not in self._at:
            raise ValueError(f"keyframe {key} is not known")
        return self._at[key]

    def current(self, agent: str) -> int | None:
        """The stretch that the agent is on now."""
        return self._current.get(agent)

    def before(self, number: int) -> int | None:
        """The node before this one on its stretch; None for the first."""
        return self._beside(number, -1)

    def after(self, number: int) -> int | None:
        """The node after this one on its stretch; None for the newest."""
        return self._beside(number, +1)

    def are_neighbours(self, a: int, b: int, gap: int) -> bool:
        """Fewer than `gap` keyframes apart on one stretch, so that odometry knows their pose best."""
        first, second = self.nodes[a], self.nodes[b]
        return first.stretch == second.stretch and abs(first.ordinal - second.ordinal) < gap

    def _beside(self, number: int, step: int) -> int | None:
        nodes = self.stretches[self.nodes[number].stretch].nodes
        at = bisect_left(nodes, number) + step
        return nodes[at] if 0 <= at < len(nodes) else None


# ---- Whose each run is, and which run of a name is its present one.


class Owners:
    """Runs by name. A run that nobody has introduced is its own name's, and present."""

    def __init__(self) -> None:
        self._name: dict[str, str] = {}
        self._latest: dict[str, str] = {}  # run of each name, the one heard of longest ago first
        self._absent: set[str] = set()

    def join(self, run: str, name: str) -> None:
        """A new run: it is its name's present one from now on."""
        self._name[run] = name
        self.present(run, True)

    def present(self, run: str, here: bool) -> bool:
        """Whether it is heard; returns whether that is news. An older run that comes back is its name's
        present one again."""
        was_absent = run in self._absent
        if not here:
            self._absent.add(run)
            return not was_absent
        self._absent.discard(run)
        name = self.name(run)
        self._latest.pop(name, None)
        self._latest[name] = run
        return was_absent

    def forget(self, run: str) -> None:
        """Nothing of it is left."""
        name = self._name.pop(run, run)
        self._absent.discard(run)
        if self._latest.get(name) == run:
            del self._latest[name]
            if left := [one for one in self._name if self._name[one] == name]:
                self._latest[name] = left[-1]

    def name(self, run: str) -> str:
        return self._name.get(run, run)

    def is_absent(self, run: str) -> bool:
        return run in self._absent

    def is_away(self, name: str) -> bool:
        """Whether none of its runs is heard."""
        return self._latest.get(name, name) in self._absent

    def is_ended(self, run: str) -> bool:
        """Whether it is not heard, and another run of its name has come after it."""
        return run in self._absent and self._latest.get(self.name(run), run) != run

    def heard_of(self) -> dict[str, int]:
        """Of each name, when its present run came or came back: in the order of these numbers."""
        return {name: at for at, name in enumerate(self._latest)}


def dues(held: Counter[str], most: Counter[str], count: int, heard_of: Mapping[str, int]) -> Counter[str]:
    """How many of `count` each name gives: again and again the one that holds most, of several the one heard
    of longest ago. So nobody who holds no more than a fair share gives anything.

    held: keyframes of each name. most: that it can give. heard_of: as `Owners.heard_of`.
    """
    out = Counter[str]()
    for _ in range(min(count, most.total())):
        able = (name for name in held if out[name] < most[name])
        out[max(able, key=lambda one: (held[one] - out[one], -heard_of.get(one, -1)))] += 1
    return out
