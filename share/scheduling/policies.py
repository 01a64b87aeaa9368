"""Who may send how much, and whether merges are gated: one class a policy.

Source: SHARE, IMWUT 10(3) 97, 2026, and what it is compared with there; see docs/understand/scheduling.md.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from share.config import ControlConfig
from share.scheduling import pid
from share.scheduling.qoe import ACCEPTED_DELAY_MS, QoeParameters, qoe, qoe_factors
from share.timing import RingBuffer
from share.types import AgentKind
from share.wire.messages import Evaluation

# ---- The delay that an agent has whatever it sends: the least of late.
#
# Source: LEDBAT (RFC 6817, 3.4.2 and 4.2), which takes what a delay is above that for a queue's. Minima of
# single minutes, the newest ten: who has come to a worse network is measured by the better one no longer.

_MINUTE_NS = 60_000_000_000
_BASE_DELAY_MINUTES = 10  # minutes


@dataclass(frozen=True)
class BaseDelay:
    """Of one agent. minima: ms by minute; none before the first delay."""

    minima: Mapping[int, float] = field(default_factory=dict)

    @property
    def ms(self) -> float:
        """inf where nothing was heard."""
        return min(self.minima.values(), default=math.inf)

    def with_delay(self, delay_ms: float, now_ns: int) -> BaseDelay:
        """With one more, heard at `now_ns`."""
        minute = now_ns // _MINUTE_NS
        minima = {
            old_minute: minimum
            for old_minute, minimum in self.minima.items()
            if minute - old_minute < _BASE_DELAY_MINUTES
        }
        minima[minute] = min(delay_ms, minima.get(minute, math.inf))
        return BaseDelay(minima)


_FULL_DROP_MS = 1000.0  # a delay at which `linear` lets nothing pass but the least rate


class Policy:
    """Of one edge. It answers each evaluation of an agent with the rate that holds from then on.

    gated: merges that would add little are skipped (`share.scheduling.merge_gate`). alike: headsets are not
    served
    before robots. limits: no agent is asked for more than `rate_max_hz`. raw: agents send what their sensors
    see, the edge tracks each alone, nothing is shared.
    """

    has_merge_gate: ClassVar[bool] = False
    treats_alike: ClassVar[bool] = True
    limits_rate: ClassVar[bool] = True
    streams_frames: ClassVar[bool] = False

    def __init__(self, config: ControlConfig) -> None:
        self._config = config

    def rate(
        self, agent: str, kind: AgentKind, delay_ms: float, error_cm: float | None, now_ns: int
    ) -> float | None:
        """Hz at which `agent` may send keyframes; None: no limit, as before its first evaluation.

        delay_ms, error_cm: as for `qoe`. now_ns: of one clock for all, when the evaluation arrived.
        """
        return None

    def forget(self, agent: str) -> None:
        """It is gone; one of its name begins anew."""


class CovinsGPolicy(Policy):
    """Every keyframe is sent, every verified loop is merged."""

    limits_rate = False


class StreamedPolicy(Policy):
    """No sharing: what agents would be without an own tracker and without each other."""

    streams_frames = True


class LinearPolicy(Policy):
    """Of the highest rate, a part is dropped that grows with the delay: none at 20 ms, all at 1 s.

    Never below the least rate: only who sends is evaluated, so who may send nothing would be silent for good.
    """

    has_merge_gate = True

    def rate(
        self, agent: str, kind: AgentKind, delay_ms: float, error_cm: float | None, now_ns: int
    ) -> float | None:
        dropped = min(1.0, max(0.0, (delay_ms - ACCEPTED_DELAY_MS) / (_FULL_DROP_MS - ACCEPTED_DELAY_MS)))
        return max(self._config.rate_min_hz, self._config.rate_max_hz * (1 - dropped))


class SharePolicy(Policy):
    """A PID controller for each agent takes its QoE to what it needs.

    With `attribution`, a QoE that is short because of delay lowers the rate: more keyframes would add to it.
    But not because of a delay that the agent has at any rate, of which 20 ms count.
    """

    has_merge_gate = True
    treats_alike = False

    def __init__(self, config: ControlConfig) -> None:
        super().__init__(config)
        self._gains = pid.PidGains.from_config(config)
        self._states: dict[str, pid.PidState] = {}
        self._base_delays: dict[str, BaseDelay] = {}

    def rate(
        self, agent: str, kind: AgentKind, delay_ms: float, error_cm: float | None, now_ns: int
    ) -> float | None:
        if self._config.attribution:
            delay_ms = self._avoidable_delay_ms(agent, delay_ms, now_ns)
        parameters = self._qoe_parameters(agent, kind)
        parts = qoe_factors(delay_ms, error_cm, parameters)
        error = parameters.target - math.prod(parts)
        if self._config.attribution and error > 0:
            error *= parts.error_attribution
        state = self._states.get(agent, pid.PidState(self._gains.rate_max_hz))
        self._states[agent] = pid.step(state, error, now_ns, self._gains)
        return self._states[agent].rate_hz

    def forget(self, agent: str) -> None:
        self._states.pop(agent, None)
        self._base_delays.pop(agent, None)

    def _avoidable_delay_ms(self, agent: str, delay_ms: float, now_ns: int) -> float:
        """ms, without what of the least delay of late is beyond 20 ms."""
        base = self._base_delays[agent] = self._base_delays.get(agent, BaseDelay()).with_delay(
            delay_ms, now_ns
        )
        return delay_ms - max(0.0, base.ms - ACCEPTED_DELAY_MS)

    def _qoe_parameters(self, agent: str, kind: AgentKind) -> QoeParameters:
        return QoeParameters.from_config(self._config, kind, agent)


class EqualPolicy(SharePolicy):
    """As `SharePolicy`, but all are taken for headset wearers."""

    treats_alike = True

    def _qoe_parameters(self, agent: str, kind: AgentKind) -> QoeParameters:
        return QoeParameters.from_config(self._config, AgentKind.AR)


class RandomPolicy(SharePolicy):
    """As `SharePolicy`, with gains drawn from 0 to twice what is set, by `random_seed`, the same for all
    agents."""

    def __init__(self, config: ControlConfig) -> None:
        super().__init__(config)
        kp, ki, kd = np.random.default_rng(config.random_seed).uniform(0.0, 2.0, 3).tolist()
        self._gains = dataclasses.replace(
            self._gains, kp=kp * config.kp, ki=ki * config.ki, kd=kd * config.kd
        )


POLICIES: dict[str, type[Policy]] = {
    "share": SharePolicy,
    "covins-g": CovinsGPolicy,
    "linear": LinearPolicy,
    "equal": EqualPolicy,
    "random": RandomPolicy,
    "streamed": StreamedPolicy,
}


# ---- Who may send how many keyframes, and how it came to that: a policy, and what it has decided so far.

_MAX_SERIES = 5000  # evaluations of an agent in a report, the newest: an hour at more than one a second


class RatedEvaluation(NamedTuple):
    """An evaluation, what it came to, and the rate since then; None where there is no limit."""

    t_s: float | None
    delay_ms: float | None
    error_cm: float | None
    qoe: float | None
    rate_hz: float | None


class RateScheduler:
    """Of one edge. Agents are known by their names here: a new run of one begins anew."""

    REPORT_FIELDS: ClassVar = ("rate_hz", "qoe")

    def __init__(self, config: ControlConfig, policy: str) -> None:
        self._config, self._policy = config, POLICIES[policy](config)
        self.max_rate_hz = config.rate_max_hz if self._policy.limits_rate else None  # that any agent may send
        self._history: dict[str, RingBuffer] = {}  # of all runs of that name
        self._latest: dict[str, RatedEvaluation] = {}  # of the present one

    def begin_run(self, agent: str) -> None:
        """A new run; it may send as much as it likes until it is evaluated."""
        self._policy.forget(agent)
        self._latest.pop(agent, None)

    def forget(self, agent: str) -> None:
        """Nothing is remembered of that name."""
        self.begin_run(agent)
        self._history.pop(agent, None)

    def evaluate(
        self, agent: str, kind: AgentKind, evaluation: Evaluation, now_ns: int, t_s: float
    ) -> float | None:
        """The rate, Hz, that is to be told; None without a limit. t_s: the time, for the report."""
        rate_hz = self._policy.rate(agent, kind, evaluation.delay_ms, evaluation.error_cm, now_ns)
        value = qoe(
            evaluation.delay_ms, evaluation.error_cm, QoeParameters.from_config(self._config, kind, agent)
        )
        rated = RatedEvaluation(
            *(_rounded(x) for x in (t_s, evaluation.delay_ms, evaluation.error_cm, value, rate_hz))
        )
        self._history.setdefault(agent, RingBuffer(len(rated), _MAX_SERIES)).add(rated)
        self._latest[agent] = rated
        return rate_hz

    def report(self, agent: str) -> dict[str, Any]:
        """edge.json's `rate_hz` and `qoe`, the newest of its present run."""
        rated = self._latest.get(agent)
        return {name: None if rated is None else getattr(rated, name) for name in self.REPORT_FIELDS}

    def series(self, agent: str) -> dict[str, list[float | None]]:
        """edge.json's `series`: a list for each column of `RatedEvaluation`."""
        rated = self._history.get(agent, RingBuffer(len(RatedEvaluation._fields), 0))
        return {name: rated.column(k) for k, name in enumerate(RatedEvaluation._fields)}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)
