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
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from share.config import BASE_POLICY, ControlConfig
from share.scheduling.base_delay import BaseDelay
from share.scheduling.qoe import ACCEPTED_DELAY_MS, QoeParameters, qoe_factors
from share.scheduling.room_budget import RateGrant
from share.scheduling.room_controller import AirtimeMeasurement, RoomController
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


_FULL_DROP_MS = 1000.0  # delay at which `linear` allows only the minimum rate


@dataclass(frozen=True)
class AgentReport:
    """An evaluation as it arrives at the edge. now_ns: by the edge's clock. keyframes, poses: of this agent,
    that have arrived so far. held_ms: how long the edge holds acknowledgements, for its disk. is_placed: see
    `share.scheduling.room_budget.AgentDemand`. arrival_ms: from the message before its newest keyframe until
    that had arrived, by the edge's clock."""

    kind: AgentKind
    evaluation: Evaluation
    now_ns: int
    keyframes: int = 0
    poses: int = 0
    held_ms: float = 0.0
    is_placed: bool = True
    arrival_ms: float = 0.0


class Policy:
    """Sets the keyframe rate of each agent of one edge, one evaluation at a time.

    has_merge_gate: merges with a small gain are skipped (`share.scheduling.merge_gate`). treats_alike:
    headsets have no priority over robots. limits_rate: no rate exceeds `rate_max_hz`. is_windowed: agents
    send no keyframe while too many are not acknowledged. streams_frames: agents send raw frames, the edge
    tracks each alone, nothing is shared.
    """

    has_merge_gate: ClassVar[bool] = False
    treats_alike: ClassVar[bool] = True
    limits_rate: ClassVar[bool] = True
    is_windowed: ClassVar[bool] = False
    streams_frames: ClassVar[bool] = False

    def __init__(self, config: ControlConfig) -> None:
        self._config = config

    def first_grant(self, agent: str, kind: AgentKind, now_ns: int) -> RateGrant | None:
        """Return what an agent that joins may send until its first evaluation; None: everything."""
        return None

    def hold_ms(self, agent: str, now_ns: int) -> float:
        """Return how long an agent that joins now holds its keyframes, ms."""
        return 0.0

    def objection(self, agent: str, kind: AgentKind, now_ns: int) -> str | None:
        """Return why the room cannot serve one more agent, for a person; None if it can."""
        return None

    def displaced(self, agent: str, kind: AgentKind, now_ns: int) -> tuple[str, ...]:
        """Return the names of the robots to remove so that a joining agent can be served."""
        return ()

    def evaluate(self, agent: str, report: AgentReport) -> RateGrant | None:
        """Return what the agent may send from now on; None: everything."""
        evaluation = report.evaluation
        hz = self.rate(agent, report.kind, evaluation.delay_ms, evaluation.error_cm, report.now_ns)
        return None if hz is None else RateGrant(hz)

    def rate(
        self, agent: str, kind: AgentKind, delay_ms: float, error_cm: float | None, now_ns: int
    ) -> float | None:
        """Return the rate in Hz by the agent's own delay and error alone, as in `qoe`; None: no limit."""
        return None

    def forget(self, agent: str) -> None:
        """Drop the state of an agent; a later run of its name starts anew."""


class CovinsGPolicy(Policy):
    """Every keyframe is sent, every verified loop is merged."""

    limits_rate = False


class FixedPolicy(Policy):
    """Every agent has `fixed_rate_hz`, at most `rate_max_hz`."""

    has_merge_gate = True

    def first_grant(self, agent: str, kind: AgentKind, now_ns: int) -> RateGrant | None:
        return self._grant

    def evaluate(self, agent: str, report: AgentReport) -> RateGrant | None:
        return self._grant

    def rate(
        self, agent: str, kind: AgentKind, delay_ms: float, error_cm: float | None, now_ns: int
    ) -> float | None:
        return self._hz

    @property
    def _grant(self) -> RateGrant:
        return RateGrant(self._hz, None, self._config.fixed_jpeg_quality)

    @property
    def _hz(self) -> float:
        return min(self._config.fixed_rate_hz, self._config.rate_max_hz)


class StreamedPolicy(Policy):
    """No sharing: agents stream frames and the edge tracks each alone."""

    streams_frames = True


class LinearPolicy(Policy):
    """The drop rate grows linearly with the delay: 0 at 20 ms, 1 at 1 s; else as `CovinsGPolicy`.

    Never below `rate_min_hz`: an agent that may send nothing would never be evaluated again.
    """

    def rate(
        self, agent: str, kind: AgentKind, delay_ms: float, error_cm: float | None, now_ns: int
    ) -> float | None:
        dropped = _clip((delay_ms - ACCEPTED_DELAY_MS) / (_FULL_DROP_MS - ACCEPTED_DELAY_MS), 0.0, 1.0)
        return max(self._config.rate_min_hz, self._config.rate_max_hz * (1 - dropped))


class SharePolicy(Policy):
    """A PID controller per agent drives its QoE to its target, within the room's budget.

    With `attribution`, a QoE that is low because of delay lowers the rate, since more keyframes would add to
    the delay. Of the base delay, which no rate avoids, at most 20 ms count: the target is what of it can be
    reached.
    """

    has_merge_gate = True
    treats_alike = False
    is_windowed = True

    def __init__(self, config: ControlConfig) -> None:
        super().__init__(config)
        self._states: dict[str, PidState] = {}
        self._base_delays: dict[str, BaseDelay] = {}
        self._base_trips: dict[str, BaseDelay] = {}
        self._room = RoomController()

    def first_grant(self, agent: str, kind: AgentKind, now_ns: int) -> RateGrant | None:
        """Slow start, until the room knows how the agent is served."""
        return self._room.first_grant(self._qoe_parameters(agent, kind).form, now_ns)

    def hold_ms(self, agent: str, now_ns: int) -> float:
        return self._room.hold_ms(agent, now_ns)

    def objection(self, agent: str, kind: AgentKind, now_ns: int) -> str | None:
        return self._room.objection(self._qoe_parameters(agent, kind).form, now_ns)

    def displaced(self, agent: str, kind: AgentKind, now_ns: int) -> tuple[str, ...]:
        return self._room.displaced(self._qoe_parameters(agent, kind).form, now_ns)

    def evaluate(self, agent: str, report: AgentReport) -> RateGrant | None:
        evaluation = report.evaluation
        hz = self.rate(agent, report.kind, evaluation.delay_ms, evaluation.error_cm, report.now_ns)
        parameters = self._qoe_parameters(agent, report.kind)
        # a ping waits for the air as well: only the base of the round trip is not air
        trip = self._base_trips.get(agent, BaseDelay()).with_delay(evaluation.rtt_ms, report.now_ns)
        self._base_trips[agent] = trip
        air_ms = max(0.0, evaluation.ack_ms - trip.ms - report.held_ms)
        air = AirtimeMeasurement(air_ms, report.arrival_ms, report.keyframes, report.poses)
        return self._room.grant(agent, parameters, hz, evaluation, air, report.now_ns, report.is_placed)

    def rate(
        self, agent: str, kind: AgentKind, delay_ms: float, error_cm: float | None, now_ns: int
    ) -> float:
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
        self._base_trips.pop(agent, None)
        self._room.forget(agent)

    def _avoidable_delay_ms(self, agent: str, delay_ms: float, now_ns: int) -> float:
        """Return the delay without the part of the base delay above 20 ms."""
        base = self._base_delays.get(agent, BaseDelay()).with_delay(delay_ms, now_ns)
        self._base_delays[agent] = base
        return delay_ms - max(0.0, base.ms - ACCEPTED_DELAY_MS)

    def _qoe_parameters(self, agent: str, kind: AgentKind) -> QoeParameters:
        return QoeParameters.from_config(self._config, kind, agent)


class SharePaperPolicy(SharePolicy):
    """The paper's algorithm to the letter: one step a keyframe, by round trip plus processing time; a low
    QoE raises the rate, whatever the reason, and there is no window and no budget."""

    is_windowed = False

    def __init__(self, config: ControlConfig) -> None:
        super().__init__(replace(config, attribution=False))

    def first_grant(self, agent: str, kind: AgentKind, now_ns: int) -> RateGrant | None:
        return None

    def hold_ms(self, agent: str, now_ns: int) -> float:
        return 0.0

    def evaluate(self, agent: str, report: AgentReport) -> RateGrant | None:
        evaluation = report.evaluation
        if evaluation.keyframe < 0:
            return RateGrant(self._states[agent].rate_hz) if agent in self._states else None
        delay_ms = evaluation.rtt_ms + evaluation.track_ms
        return RateGrant(self.rate(agent, report.kind, delay_ms, evaluation.error_cm, report.now_ns))


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
    "share-paper": SharePaperPolicy,
    BASE_POLICY: CovinsGPolicy,
    "linear": LinearPolicy,
    "equal": EqualPolicy,
    "random": RandomPolicy,
    "fixed": FixedPolicy,
    "streamed": StreamedPolicy,
}
