"""The policy of one edge at work, and the history of its decisions."""

from __future__ import annotations

from typing import NamedTuple

from share.config import ControlConfig
from share.scheduling.policies import POLICIES, AgentReport
from share.scheduling.qoe import QoeParameters, qoe
from share.scheduling.room_budget import RateGrant
from share.timing import RingBuffer
from share.types import AgentKind

_MAX_SERIES = 5000  # newest evaluations of an agent in a report: an hour at more than one a second


class RatedEvaluation(NamedTuple):
    """An evaluation, its QoE, and the rate set by it; None: no limit. track_ms, comm_ms, comp_ms: parts of
    the delay."""

    t_s: float | None
    delay_ms: float | None
    error_cm: float | None
    qoe: float | None
    rate_hz: float | None
    track_ms: float | None
    comm_ms: float | None
    comp_ms: float | None


class RateScheduler:
    """A policy and the history of its decisions, for one edge. Agents go by name; a new run starts anew."""

    def __init__(self, config: ControlConfig, policy: str) -> None:
        self._config, self._policy = config, POLICIES[policy](config)
        self.max_rate_hz = config.rate_max_hz if self._policy.limits_rate else None  # None: no limit
        self.is_windowed = self._policy.is_windowed
        self._is_full = False
        self._history: dict[str, RingBuffer] = {}  # of all runs of a name
        self._latest: dict[str, RatedEvaluation] = {}  # of the present run
        self._targets: dict[tuple[str, AgentKind], float] = {}  # by name, "" of one without own parameters

    def begin_run(self, agent: str) -> None:
        """Start a new run of an agent, without a limit until its first evaluation."""
        self._policy.forget(agent)
        self._latest.pop(agent, None)

    def forget(self, agent: str) -> None:
        """Drop all state and history of a name."""
        self.begin_run(agent)
        self._history.pop(agent, None)

    def first_grant(self, agent: str, kind: AgentKind, now_ns: int) -> RateGrant | None:
        """Return what an agent that joins may send; None: everything."""
        return self._policy.first_grant(agent, kind, now_ns)

    def hold_ms(self, agent: str, now_ns: int) -> float:
        """Return how long an agent that joins now holds its keyframes, ms."""
        return self._policy.hold_ms(agent, now_ns)

    def objection(self, agent: str, kind: AgentKind, now_ns: int) -> str | None:
        """Return why the room cannot serve one more agent, for a person; None if it can."""
        return self._policy.objection(agent, kind, now_ns)

    def displaced(self, agent: str, kind: AgentKind, now_ns: int) -> tuple[str, ...]:
        """Return the names of the robots to remove so that a joining agent can be served."""
        return self._policy.displaced(agent, kind, now_ns)

    def capacity_change(self, now_ns: int) -> str | None:
        """Return a line if the room has become full, or has capacity again; None if unchanged."""
        was_full, self._is_full = self._is_full, (reason := self.full_reason(now_ns)) is not None
        return None if was_full == self._is_full else reason or "there is room again"

    def full_reason(self, now_ns: int) -> str | None:
        """Return why nobody, or no robot, can join now, for a person; None if all can."""
        reasons = (self._policy.objection("", kind, now_ns) for kind in AgentKind)
        return next(filter(None, reasons), None)

    def evaluate(self, agent: str, report: AgentReport, comp_ms: float, t_s: float) -> RateGrant | None:
        """Return what the agent may send from now on; None: everything. comp_ms: the edge's part of its
        delay. t_s: time for the report."""
        grant, evaluation = self._policy.evaluate(agent, report), report.evaluation
        delay_ms, error_cm, track_ms = evaluation.delay_ms, evaluation.error_cm, evaluation.track_ms
        value = qoe(delay_ms, error_cm, QoeParameters.from_config(self._config, report.kind, agent))
        comm_ms = max(0.0, delay_ms - track_ms - comp_ms)
        rate_hz = None if grant is None else grant.hz
        fields = t_s, delay_ms, error_cm, value, rate_hz, track_ms, comm_ms, comp_ms
        rated = RatedEvaluation(*(None if x is None else round(x, 4) for x in fields))
        self._history.setdefault(agent, RingBuffer(len(rated), _MAX_SERIES)).add(rated)
        self._latest[agent] = rated
        return grant

    def report(self, agent: str | None, kind: AgentKind) -> dict[str, float | None]:
        """Return what edge.json has of an agent's present run; None: no run."""
        rated = None if agent is None else self._latest.get(agent)
        newest = {
            name: None if rated is None else getattr(rated, name)
            for name in ("rate_hz", "qoe", "delay_ms", "error_cm")
        }
        return {**newest, "qoe_target": self._target(agent or "", kind)}

    def _target(self, agent: str, kind: AgentKind) -> float:
        key = agent if agent in self._config.agents else "", kind
        if key not in self._targets:
            self._targets[key] = QoeParameters.from_config(self._config, kind, key[0]).target
        return self._targets[key]

    def series(self, agent: str) -> dict[str, list[float | None]]:
        """Return `series` for edge.json: a list for each field of `RatedEvaluation`."""
        rated = self._history.get(agent, RingBuffer(len(RatedEvaluation._fields), 0))
        return {name: rated.column(k) for k, name in enumerate(RatedEvaluation._fields)}
