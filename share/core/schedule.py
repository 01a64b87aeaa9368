"""Who may send how many keyframes, and how it came to that: a policy, and what it has decided so far."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from share.config import ControlConfig
from share.control.policies import POLICIES
from share.control.qoe import Needs, qoe
from share.core.history import History
from share.types import AgentKind
from share.wire.messages import Evaluation

_REMEMBERED = 5000  # evaluations of an agent in a report, the newest: an hour at more than one a second


class Rated(NamedTuple):
    """An evaluation, what it came to, and the rate since then; None where there is no limit."""

    t_s: float | None
    delay_ms: float | None
    error_cm: float | None
    qoe: float | None
    rate_hz: float | None


class Schedule:
    """Of one edge. Agents are known by their names here: a new run of one begins anew."""

    REPORTED: ClassVar = ("rate_hz", "qoe")

    def __init__(self, config: ControlConfig, policy: str) -> None:
        self._config, self._policy = config, POLICIES[policy](config)
        self.most_hz = config.rate_max_hz if self._policy.limits else None  # that any agent may send
        self._rated: dict[str, History] = {}  # of all runs of that name
        self._newest: dict[str, Rated] = {}  # of the present one

    def begin(self, agent: str) -> None:
        """A new run; it may send as much as it likes until it is evaluated."""
        self._policy.forget(agent)
        self._newest.pop(agent, None)

    def drop(self, agent: str) -> None:
        """Nothing is remembered of that name."""
        self.begin(agent)
        self._rated.pop(agent, None)

    def evaluated(
        self, agent: str, kind: AgentKind, told: Evaluation, now_ns: int, t_s: float
    ) -> float | None:
        """The rate, Hz, that is to be told; None without a limit. t_s: the time, for the report."""
        rate_hz = self._policy.rate(agent, kind, told.delay_ms, told.error_cm, now_ns)
        value = qoe(told.delay_ms, told.error_cm, Needs.of(self._config, kind, agent))
        rated = Rated(*(_rounded(x) for x in (t_s, told.delay_ms, told.error_cm, value, rate_hz)))
        self._rated.setdefault(agent, History(len(rated), _REMEMBERED)).add(rated)
        self._newest[agent] = rated
        return rate_hz

    def report(self, agent: str) -> dict[str, Any]:
        """edge.json's `rate_hz` and `qoe`, the newest of its present run."""
        rated = self._newest.get(agent)
        return {name: None if rated is None else getattr(rated, name) for name in self.REPORTED}

    def series(self, agent: str) -> dict[str, list[float | None]]:
        """edge.json's `series`: a list for each column of `Rated`."""
        rated = self._rated.get(agent, History(len(Rated._fields), 0))
        return {name: rated.column(k) for k, name in enumerate(Rated._fields)}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)
