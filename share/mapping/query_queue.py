"""Which keyframe is looked up next: fair between agents, headsets before robots, the newest first."""

from __future__ import annotations

from collections import Counter, deque

from share.config import Config, EdgeConfig
from share.scheduling.policies import POLICIES
from share.scheduling.qoe import QoeParameters
from share.types import AgentKind
from share.wire.messages import Hello

MIN_BACKLOG = 1  # with this many queued, a query verifies fewer candidates
MAX_WAITING_EACH = 3  # queued queries of one agent
_NEWEST_CONSIDERED = 4  # agents with the newest keyframes; older ones would be answered too late
_TURN_WEIGHT = {AgentKind.AR: 4, AgentKind.ROBOT: 1}  # a robot waits four times as many turns as a headset
_MAX_SKIPPED = 100  # newest skipped keyframes, which may be looked up when nothing waits


def service_kind(config: Config, hello: Hello) -> AgentKind:
    """Kind that sets the agent's share of look-ups; AR for all under policies that treat agents alike."""
    if POLICIES[config.edge.policy].treats_alike:
        return AgentKind.AR
    return QoeParameters.from_config(config.control, hello.kind, hello.name).form


class QueryQueue:
    """Keyframes that wait to be looked up: at most `edge.max_waiting`, and MAX_WAITING_EACH of an agent.

    Beyond that the oldest one, of this agent or of the one with most, is skipped (policy skip_oldest_query):
    an answer that late is of no use.
    """

    def __init__(self, config: EdgeConfig) -> None:
        self.skipped: Counter[str] = Counter()  # by agent
        self._config = config
        self._waiting: dict[str, deque[int]] = {}
        self._weights: dict[str, int] = {}
        self._last_turn: dict[str, int] = {}  # number of each agent's last turn
        self._turn = 0
        self._skipped_ids = deque[int](maxlen=_MAX_SKIPPED)

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    @property
    def has_backlog(self) -> bool:
        """Return whether so many wait that the current search should end soon."""
        return len(self) >= MIN_BACKLOG

    def remove_agent(self, agent: str) -> None:
        for per_agent in (self.skipped, self._waiting, self._weights, self._last_turn):
            per_agent.pop(agent, None)

    def add(self, agent: str, kind: AgentKind, node_id: int, is_extra: bool = False) -> None:
        """Add a keyframe; with is_extra it is skipped at once."""
        if is_extra:
            self._mark_skipped(agent, node_id)
            return
        self._weights[agent] = _TURN_WEIGHT[kind]
        self._last_turn.setdefault(agent, self._turn)
        self._waiting.setdefault(agent, deque()).append(node_id)
        if len(self._waiting[agent]) > MAX_WAITING_EACH:
            self._skip_oldest(agent)
        elif len(self) > self._config.max_waiting:
            self._skip_oldest(max(self._waiting, key=lambda name: len(self._waiting[name])))

    def next_query(self) -> int | None:
        """Take the newest waiting keyframe of the agent whose turn it is, or None.

        Among the agents with the newest keyframes, it is the turn of the one that waited longest, weighted by
        kind.
        """
        if not self._waiting:
            return None
        self._turn += 1
        newest = sorted(self._waiting, key=lambda name: self._waiting[name][-1])[-_NEWEST_CONSIDERED:]
        agent = max(newest, key=lambda name: (self._turn - self._last_turn[name]) * self._weights[name])
        self._last_turn[agent] = self._turn
        return self._pop(agent, is_oldest=False)

    def next_skipped(self) -> int | None:
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
