"""Whose keyframe is looked up next: fair between agents, headsets before robots, the newest first."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from share.config import Config, EdgeConfig
from share.geometry import se3
from share.mapping.map_graph import MapGraph
from share.scheduling.policies import POLICIES
from share.scheduling.qoe import QoeParameters
from share.types import F64, AgentKind
from share.wire.messages import Hello

# ---- Which candidates for a keyframe's place are tried: as many as are worth it, fewer while others wait.


class SearchBudget(NamedTuple):
    """enough: verified candidates after which the rest is left alone. While others wait one is, and no more
    than `max_tried_hurried` are tried."""

    max_verified: int
    max_tried_hurried: int

    @classmethod
    def from_config(cls, config: Config) -> SearchBudget:
        return cls(config.place.enough, config.edge.hurry_candidates)


class CandidateSearch:
    """For the place of keyframe `node_id`; candidates: best first. What comes to wait meanwhile hurries
    it."""

    def __init__(self, node_id: int, candidates: Iterable[int], budget: SearchBudget) -> None:
        self.node_id = node_id
        self._remaining, self._budget = deque(candidates), budget
        self._tried_count = self._verified_count = 0

    def next_candidate(self, is_hurried: bool) -> int | None:
        """The candidate to try now; None when there are no more, or enough."""
        max_tried = self._budget.max_tried_hurried if is_hurried else self._tried_count + 1
        max_verified = 1 if is_hurried else self._budget.max_verified
        if not self._remaining or self._tried_count >= max_tried or self._verified_count >= max_verified:
            return None
        self._tried_count += 1
        return self._remaining.popleft()

    def count_verified(self) -> None:
        """The last one is it."""
        self._verified_count += 1


_NEWEST_CONSIDERED = (
    4  # so many newest keyframes are looked up before others: who waits too long is answered too late
)
_TURN_WEIGHT = {AgentKind.AR: 4, AgentKind.ROBOT: 1}  # a robot waits four times as many turns as a headset
_MAX_SKIPPED = 100  # passed over, the newest: those that may still be looked up when nothing else waits


def qoe_form(config: Config, hello: Hello) -> AgentKind:
    """By its needs, not by what it is."""
    return QoeParameters.from_config(config.control, hello.kind, hello.name).form


def service_kind(config: Config, hello: Hello) -> AgentKind:
    """By its form; by a policy that takes agents alike, as anybody."""
    if POLICIES[config.edge.policy].treats_alike:
        return AgentKind.AR
    return qoe_form(config, hello)


class QueryQueue:
    """Keyframes that wait to be looked up, at most `edge.max_waiting`, and `each_waiting` of an agent: what
    waits longer is answered when nobody asks any more.

    One too many: the oldest, of this agent or of the one with most of them, is passed over (policy
    skip_oldest_query).
    """

    def __init__(self, config: EdgeConfig) -> None:
        self.skipped: Counter[str] = Counter()  # by agent
        self._config = config
        self._waiting: dict[str, deque[int]] = {}
        self._weights: dict[str, int] = {}
        self._last_turn: dict[str, int] = {}  # when, in turns
        self._turn = 0
        self._skipped_ids = deque[int](maxlen=_MAX_SKIPPED)

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    @property
    def is_hurried(self) -> bool:
        """So many wait that the one at hand should soon be done."""
        return len(self) >= self._config.hurry_waiting

    def remove_agent(self, agent: str) -> None:
        """Nothing of it waits."""
        for per_agent in (self.skipped, self._waiting, self._weights, self._last_turn):
            per_agent.pop(agent, None)

    def add(self, agent: str, kind: AgentKind, node_id: int, is_extra: bool = False) -> None:
        """is_extra: it is passed over at once."""
        if is_extra:
            self._mark_skipped(agent, node_id)
            return
        self._weights[agent] = _TURN_WEIGHT[kind]
        self._last_turn.setdefault(agent, self._turn)
        self._waiting.setdefault(agent, deque()).append(node_id)
        if len(self._waiting[agent]) > self._config.each_waiting:
            self._skip_oldest(agent)
        elif len(self) > self._config.max_waiting:
            self._skip_oldest(max(self._waiting, key=lambda name: len(self._waiting[name])))

    def next_query(self) -> int | None:
        """Of the newest keyframes, that of the agent that has waited longest for its turn; None without."""
        if not self._waiting:
            return None
        self._turn += 1
        newest = sorted(self._waiting, key=lambda name: self._waiting[name][-1])[-_NEWEST_CONSIDERED:]
        agent = max(newest, key=lambda name: (self._turn - self._last_turn[name]) * self._weights[name])
        self._last_turn[agent] = self._turn
        return self._pop(agent, is_oldest=False)

    def next_skipped(self) -> int | None:
        """Of those that were passed over, the newest; None without."""
        return self._skipped_ids.pop() if self._skipped_ids else None

    def _skip_oldest(self, agent: str) -> None:
        self._mark_skipped(agent, self._pop(agent, is_oldest=True))

    def _mark_skipped(self, agent: str, node_id: int) -> None:
        self._skipped_ids.append(node_id)
        self.skipped[agent] += 1

    def _pop(self, agent: str, is_oldest: bool) -> int:
        queue = self._waiting[agent]
        node_id = queue.popleft() if is_oldest else queue.pop()
        if not queue:
            del self._waiting[agent]
        return node_id


# ---- Which look-alikes of a keyframe to try first where there is no time to try them all.

_FAR_M, _FAR_RAD = 4.0, 1.0  # views of one map further apart than this, or turned more, seldom share enough


def rank_candidates(graph: MapGraph, node_id: int, others: Sequence[int]) -> list[int]:
    """`others`, of which those of larger maps come first, for agents are to end up in one; last those that
    this keyframe cannot see if its map is right. Where it is wrong they are still tried, but later."""
    nodes = graph.odometry.nodes
    sizes: Counter[int] = Counter()
    for segment, reference_segment in zip(graph.odometry.segments, graph.reference_segments, strict=True):
        sizes[reference_segment] += len(segment.nodes)

    def rank(other: int) -> tuple[bool, int]:
        size = sizes[graph.reference_segments[nodes[other].segment]]
        return graph.is_same_map(node_id, other) and _are_far(graph.poses[node_id], graph.poses[other]), -size

    return sorted(others, key=rank)


def _are_far(T_map_a: F64, T_map_b: F64) -> bool:
    T = se3.inverse(T_map_a) @ T_map_b
    return bool(np.linalg.norm(T[:3, 3]) > _FAR_M or se3.rotation_angle(T) > _FAR_RAD)
