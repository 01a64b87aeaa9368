"""Whose keyframe is looked up next: fair between agents, headsets before robots, the newest first."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from share.config import Config, EdgeConfig
from share.geometry import se3
from share.mapping.map_graph import Chart
from share.scheduling.policies import POLICIES
from share.scheduling.qoe import Needs
from share.types import F64, AgentKind
from share.wire.messages import Hello

# ---- Which candidates for a keyframe's place are tried: as many as are worth it, fewer while others wait.


class Effort(NamedTuple):
    """enough: verified candidates after which the rest is left alone. While others wait one is, and no more
    than `hurried` are tried."""

    enough: int
    hurried: int

    @classmethod
    def of(cls, config: Config) -> Effort:
        return cls(config.place.enough, config.edge.hurry_candidates)


class Search:
    """For the place of keyframe `number`; candidates: best first. What comes to wait meanwhile hurries it."""

    def __init__(self, number: int, candidates: Iterable[int], effort: Effort) -> None:
        self.number = number
        self._left, self._effort = deque(candidates), effort
        self._tried = self._verified = 0

    def next(self, in_a_hurry: bool) -> int | None:
        """The candidate to try now; None when there are no more, or enough."""
        most = self._effort.hurried if in_a_hurry else self._tried + 1
        enough = 1 if in_a_hurry else self._effort.enough
        if not self._left or self._tried >= most or self._verified >= enough:
            return None
        self._tried += 1
        return self._left.popleft()

    def verified(self) -> None:
        """The last one is it."""
        self._verified += 1


_FRESH = 4  # so many newest keyframes are looked up before others: who waits too long is answered too late
_WEIGHT = {AgentKind.AR: 4, AgentKind.ROBOT: 1}  # a robot waits four times as many turns as a headset
_LATE = 100  # passed over, the newest: those that may still be looked up when nothing else waits


def form_of(config: Config, hello: Hello) -> AgentKind:
    """By its needs, not by what it is."""
    return Needs.of(config.control, hello.kind, hello.name).form


def served_as(config: Config, hello: Hello) -> AgentKind:
    """By its form; by a policy that takes agents alike, as anybody."""
    if POLICIES[config.edge.policy].alike:
        return AgentKind.AR
    return form_of(config, hello)


class Lookups:
    """Keyframes that wait to be looked up, at most `edge.max_waiting`, and `each_waiting` of an agent: what
    waits longer is answered when nobody asks any more.

    One too many: the oldest, of this agent or of the one with most of them, is passed over (policy
    skip_oldest_query).
    """

    def __init__(self, config: EdgeConfig) -> None:
        self.skipped: Counter[str] = Counter()  # by agent
        self._config = config
        self._waiting: dict[str, deque[int]] = {}
        self._weight: dict[str, int] = {}
        self._served: dict[str, int] = {}  # when, in turns
        self._turn = 0
        self._late = deque[int](maxlen=_LATE)

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    @property
    def in_a_hurry(self) -> bool:
        """So many wait that the one at hand should soon be done."""
        return len(self) >= self._config.hurry_waiting

    def forget(self, agent: str) -> None:
        """Nothing of it waits."""
        for known in (self.skipped, self._waiting, self._weight, self._served):
            known.pop(agent, None)

    def add(self, agent: str, kind: AgentKind, number: int, is_extra: bool = False) -> None:
        """is_extra: it is passed over at once."""
        if is_extra:
            self._pass_over(agent, number)
            return
        self._weight[agent] = _WEIGHT[kind]
        self._served.setdefault(agent, self._turn)
        self._waiting.setdefault(agent, deque()).append(number)
        if len(self._waiting[agent]) > self._config.each_waiting:
            self._skip(agent)
        elif len(self) > self._config.max_waiting:
            self._skip(max(self._waiting, key=lambda name: len(self._waiting[name])))

    def next(self) -> int | None:
        """Of the newest keyframes, that of the agent that has waited longest for its turn; None without."""
        if not self._waiting:
            return None
        self._turn += 1
        newest = sorted(self._waiting, key=lambda name: self._waiting[name][-1])[-_FRESH:]
        agent = max(newest, key=lambda name: (self._turn - self._served[name]) * self._weight[name])
        self._served[agent] = self._turn
        return self._take(agent, oldest=False)

    def next_late(self) -> int | None:
        """Of those that were passed over, the newest; None without."""
        return self._late.pop() if self._late else None

    def _skip(self, agent: str) -> None:
        self._pass_over(agent, self._take(agent, oldest=True))

    def _pass_over(self, agent: str, number: int) -> None:
        self._late.append(number)
        self.skipped[agent] += 1

    def _take(self, agent: str, oldest: bool) -> int:
        queue = self._waiting[agent]
        number = queue.popleft() if oldest else queue.pop()
        if not queue:
            del self._waiting[agent]
        return number


# ---- Which look-alikes of a keyframe to try first where there is no time to try them all.

_FAR_M, _FAR_RAD = 4.0, 1.0  # views of one map further apart than this, or turned more, seldom share enough


def promising_first(chart: Chart, number: int, others: Sequence[int]) -> list[int]:
    """`others`, of which those of larger maps come first, for agents are to end up in one; last those that
    this keyframe cannot see if its map is right. Where it is wrong they are still tried, but later."""
    nodes = chart.trails.nodes
    sizes: Counter[int] = Counter()
    for stretch, founder in zip(chart.trails.stretches, chart.founder, strict=True):
        sizes[founder] += len(stretch.nodes)

    def rank(other: int) -> tuple[bool, int]:
        size = sizes[chart.founder[nodes[other].stretch]]
        return chart.same_map(number, other) and _are_far(chart.poses[number], chart.poses[other]), -size

    return sorted(others, key=rank)


def _are_far(T_map_a: F64, T_map_b: F64) -> bool:
    T = se3.inverse(T_map_a) @ T_map_b
    return bool(np.linalg.norm(T[:3, 3]) > _FAR_M or se3.angle(T) > _FAR_RAD)
