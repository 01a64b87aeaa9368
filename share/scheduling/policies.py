"""Scheduling policies: the keyframe rate of each agent, and whether merges are gated. One class a policy.

The PID controller of policy share makes one step per evaluation:

    e = Q* - Q;  P = Kp e;  I = clip(I + Ki e dt, +-I_max)
    d = alpha (e - e_prev)/dt + (1 - alpha) d_prev;  D = Kd d
    R = clip(R_prev + P + I + D, R_min, R_max)

Source: SHARE, IMWUT 10(3) 97, 2026, and its baselines; see docs/understand/scheduling.md. Filtered
derivative and bounded integral: Astrom and Hagglund, *Advanced PID Control* (2006). Each step adds to R, so
a persistent error drives the rate to a bound.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import numpy as np

from share.config import ControlConfig
from share.scheduling.qoe import ACCEPTED_DELAY_MS, QoeParameters, qoe, qoe_factors
from share.timing import RingBuffer
from share.types import AgentKind
from share.wire.messages import Evaluation

INTEGRAL_MAX_HZ = 0.1  # I_max: the past never outweighs the present
DERIVATIVE_WEIGHT = 0.3  # alpha, of the newest slope: about the mean of three evaluations
GAP_S = 5.0  # without an evaluation for longer, the derivative is reset and the integral held


@dataclass(frozen=True)
class PidState:
    """State of one agent's controller after an evaluation. integral_hz: I. derivative: d, 1/s. updated_ns:
    time of the evaluation; None before the first."""

    rate_hz: float
    error: float = 0.0
    integral_hz: float = 0.0
    derivative: float = 0.0
    updated_ns: int | None = None


def pid_step(state: PidState, error: float, now_ns: int, gains: ControlConfig) -> PidState:
    """Return the state after an evaluation at `now_ns`. error: target minus QoE, finite.

    The first evaluation, one with dt <= 0 and one after a gap have no derivative: d = 0, I is held.
    """
    dt = 0.0 if state.updated_ns is None else (now_ns - state.updated_ns) / 1e9
    integral, derivative = state.integral_hz, 0.0
    if 0 < dt <= GAP_S:
        integral = _clip(integral + gains.ki * error * dt, -INTEGRAL_MAX_HZ, INTEGRAL_MAX_HZ)
        derivative = (
            DERIVATIVE_WEIGHT * (error - state.error) / dt + (1 - DERIVATIVE_WEIGHT) * state.derivative
        )
    rate = state.rate_hz + gains.kp * error + integral + gains.kd * derivative
    return PidState(_clip(rate, gains.rate_min_hz, gains.rate_max_hz), error, integral, derivative, now_ns)


def _clip(value: float, low: float, high: float) -> float:
    return min(high, max(low, value))


_MINUTE_NS = 60_000_000_000
_BASE_DELAY_MINUTES = 10  # after a change to a slower network the old minimum expires


@dataclass(frozen=True)
class BaseDelay:
    """Base delay of one agent: the minimum of the last minutes, which does not depend on what it sends.

    minima: ms by minute. Source: LEDBAT (RFC 6817, 3.4.2 and 4.2), which attributes delay above it to
    queues."""

    minima: Mapping[int, float] = field(default_factory=dict)

    @property
    def ms(self) -> float:
        """The base delay, ms; inf before the first delay."""
        return min(self.minima.values(), default=math.inf)

    def with_delay(self, delay_ms: float, now_ns: int) -> BaseDelay:
        """Return the base delay with one more measurement, at `now_ns`."""
        minute = now_ns // _MINUTE_NS
        minima = {old: ms for old, ms in self.minima.items() if minute - old < _BASE_DELAY_MINUTES}
        minima[minute] = min(delay_ms, minima.get(minute, math.inf))
        return BaseDelay(minima)


LOW_QOE = 0.5  # share of its target below which a QoE is low
_FULL_DROP_MS = 1000.0  # delay at which `linear` allows only the minimum rate


class Policy:
    """Sets the keyframe rate of each agent of one edge, one evaluation at a time.

    has_merge_gate: merges with a small gain are skipped (`share.scheduling.merge_gate`). treats_alike:
    headsets have no priority over robots. limits_rate: no rate exceeds `rate_max_hz`. streams_frames: agents
    send raw frames, the edge tracks each alone, nothing is shared.
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
        """Return the rate in Hz at which `agent` may send keyframes; None: no limit, as before its first
        evaluation.

        delay_ms, error_cm: as in `qoe`. now_ns: arrival of the evaluation, by the edge's clock.
        """
        return None

    def forget(self, agent: str) -> None:
        """Drop the state of an agent; a later run of its name starts anew."""


class CovinsGPolicy(Policy):
    """Every keyframe is sent, every verified loop is merged."""

    limits_rate = False


class StreamedPolicy(Policy):
    """No sharing: agents stream frames and the edge tracks each alone."""

    streams_frames = True


class LinearPolicy(Policy):
    """The drop rate grows linearly with the delay: 0 at 20 ms, 1 at 1 s.

    Never below `rate_min_hz`: an agent that may send nothing would never be evaluated again.
    """

    has_merge_gate = True

    def rate(
        self, agent: str, kind: AgentKind, delay_ms: float, error_cm: float | None, now_ns: int
    ) -> float | None:
        dropped = _clip((delay_ms - ACCEPTED_DELAY_MS) / (_FULL_DROP_MS - ACCEPTED_DELAY_MS), 0.0, 1.0)
        return max(self._config.rate_min_hz, self._config.rate_max_hz * (1 - dropped))


class SharePolicy(Policy):
    """A PID controller per agent drives its QoE to its target.

    With `attribution`, a QoE that is low because of delay lowers the rate, since more keyframes would add to
    the delay. Of the base delay, which no rate avoids, at most 20 ms count.
    """

    has_merge_gate = True
    treats_alike = False

    def __init__(self, config: ControlConfig) -> None:
        super().__init__(config)
        self._states: dict[str, PidState] = {}
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
        state = self._states.get(agent, PidState(self._config.rate_max_hz))
        self._states[agent] = pid_step(state, error, now_ns, self._config)
        return self._states[agent].rate_hz

    def forget(self, agent: str) -> None:
        self._states.pop(agent, None)
        self._base_delays.pop(agent, None)

    def _avoidable_delay_ms(self, agent: str, delay_ms: float, now_ns: int) -> float:
        """Return the delay without the part of the base delay above 20 ms."""
        base = self._base_delays.get(agent, BaseDelay()).with_delay(delay_ms, now_ns)
        self._base_delays[agent] = base
        return delay_ms - max(0.0, base.ms - ACCEPTED_DELAY_MS)

    def _qoe_parameters(self, agent: str, kind: AgentKind) -> QoeParameters:
        return QoeParameters.from_config(self._config, kind, agent)


class EqualPolicy(SharePolicy):
    """As `SharePolicy`, with the AR form of QoE for every agent."""

    treats_alike = True

    def _qoe_parameters(self, agent: str, kind: AgentKind) -> QoeParameters:
        return QoeParameters.from_config(self._config, AgentKind.AR)


class RandomPolicy(SharePolicy):
    """As `SharePolicy`, with gains drawn uniformly from 0 to twice the configured ones by `random_seed`, the
    same for all agents."""

    def __init__(self, config: ControlConfig) -> None:
        kp, ki, kd = np.random.default_rng(config.random_seed).uniform(0.0, 2.0, 3).tolist()
        super().__init__(replace(config, kp=kp * config.kp, ki=ki * config.ki, kd=kd * config.kd))


POLICIES: dict[str, type[Policy]] = {
    "share": SharePolicy,
    "covins-g": CovinsGPolicy,
    "linear": LinearPolicy,
    "equal": EqualPolicy,
    "random": RandomPolicy,
    "streamed": StreamedPolicy,
}


_MAX_SERIES = 5000  # newest evaluations of an agent in a report: an hour at more than one a second


class RatedEvaluation(NamedTuple):
    """An evaluation, its QoE, and the rate set by it; None: no limit."""

    t_s: float | None
    delay_ms: float | None
    error_cm: float | None
    qoe: float | None
    rate_hz: float | None


class RateScheduler:
    """A policy and the history of its decisions, for one edge. Agents go by name; a new run starts anew."""

    def __init__(self, config: ControlConfig, policy: str) -> None:
        self._config, self._policy = config, POLICIES[policy](config)
        self.max_rate_hz = config.rate_max_hz if self._policy.limits_rate else None  # None: no limit
        self._history: dict[str, RingBuffer] = {}  # of all runs of a name
        self._latest: dict[str, RatedEvaluation] = {}  # of the present run
        self._low_since_s: dict[str, float] = {}  # of the present run, while its QoE is low

    def begin_run(self, agent: str) -> None:
        """Start a new run of an agent, without a limit until its first evaluation."""
        self._policy.forget(agent)
        self._latest.pop(agent, None)
        self._low_since_s.pop(agent, None)

    def forget(self, agent: str) -> None:
        """Drop all state and history of a name."""
        self.begin_run(agent)
        self._history.pop(agent, None)

    def evaluate(
        self, agent: str, kind: AgentKind, evaluation: Evaluation, now_ns: int, t_s: float
    ) -> float | None:
        """Return the rate to send to the agent, Hz; None: no limit. t_s: time for the report."""
        rate_hz = self._policy.rate(agent, kind, evaluation.delay_ms, evaluation.error_cm, now_ns)
        delay_ms, error_cm = evaluation.delay_ms, evaluation.error_cm
        parameters = QoeParameters.from_config(self._config, kind, agent)
        value = qoe(delay_ms, error_cm, parameters)
        if value < LOW_QOE * parameters.target:
            self._low_since_s.setdefault(agent, t_s)
        else:
            self._low_since_s.pop(agent, None)
        rated = RatedEvaluation(
            *(None if x is None else round(x, 4) for x in (t_s, delay_ms, error_cm, value, rate_hz))
        )
        self._history.setdefault(agent, RingBuffer(len(rated), _MAX_SERIES)).add(rated)
        self._latest[agent] = rated
        return rate_hz

    def report(self, agent: str | None, kind: AgentKind) -> dict[str, float | None]:
        """Return what edge.json has of an agent's present run; None: no run. qoe_low_s: how long its QoE has
        been below half of its target."""
        rated = None if agent is None else self._latest.get(agent)
        low_since_s = None if agent is None else self._low_since_s.get(agent)
        low_s = 0.0 if rated is None or rated.t_s is None or low_since_s is None else rated.t_s - low_since_s
        newest = {
            name: None if rated is None else getattr(rated, name)
            for name in ("rate_hz", "qoe", "delay_ms", "error_cm")
        }
        target = QoeParameters.from_config(self._config, kind, agent or "").target
        return {**newest, "qoe_target": target, "qoe_low_s": round(low_s, 3)}

    def series(self, agent: str) -> dict[str, list[float | None]]:
        """Return `series` for edge.json: a list for each field of `RatedEvaluation`."""
        rated = self._history.get(agent, RingBuffer(len(RatedEvaluation._fields), 0))
        return {name: rated.column(k) for k, name in enumerate(RatedEvaluation._fields)}
