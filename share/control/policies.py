"""Who may send how much, and whether merges are gated: one class a policy.

Source: SHARE, IMWUT 10(3) 97, 2026, and what it is compared with there; see docs/scheduling.md.
"""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

import numpy as np

from share.config import ControlConfig
from share.control import pid
from share.control.base_delay import BaseDelay
from share.control.qoe import DELAY_MS, Needs, factors
from share.types import AgentKind

_NONE_MS = 1000.0  # a delay at which `linear` lets nothing pass but the least rate


class Policy:
    """Of one edge. It answers each evaluation of an agent with the rate that holds from then on.

    gated: merges that would add little are skipped (`share.control.gate`). alike: headsets are not served
    before robots. limits: no agent is asked for more than `rate_max_hz`. raw: agents send what their sensors
    see, the edge tracks each alone, nothing is shared.
    """

    gated: ClassVar[bool] = False
    alike: ClassVar[bool] = True
    limits: ClassVar[bool] = True
    raw: ClassVar[bool] = False

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


class CovinsG(Policy):
    """Every keyframe is sent, every verified loop is merged."""

    limits = False


class Streamed(Policy):
    """No sharing: what agents would be without an own tracker and without each other."""

    raw = True


class Linear(Policy):
    """Of the highest rate, a part is dropped that grows with the delay: none at 20 ms, all at 1 s.

    Never below the least rate: only who sends is evaluated, so who may send nothing would be silent for good.
    """

    gated = True

    def rate(
        self, agent: str, kind: AgentKind, delay_ms: float, error_cm: float | None, now_ns: int
    ) -> float | None:
        dropped = min(1.0, max(0.0, (delay_ms - DELAY_MS) / (_NONE_MS - DELAY_MS)))
        return max(self._config.rate_min_hz, self._config.rate_max_hz * (1 - dropped))


class Share(Policy):
    """A PID controller for each agent takes its QoE to what it needs.

    With `attribution`, a QoE that is short because of delay lowers the rate: more keyframes would add to it.
    But not because of a delay that the agent has at any rate, of which 20 ms count.
    """

    gated = True
    alike = False

    def __init__(self, config: ControlConfig) -> None:
        super().__init__(config)
        self._gains = pid.Gains.of(config)
        self._states: dict[str, pid.State] = {}
        self._bases: dict[str, BaseDelay] = {}

    def rate(
        self, agent: str, kind: AgentKind, delay_ms: float, error_cm: float | None, now_ns: int
    ) -> float | None:
        if self._config.attribution:
            delay_ms = self._avoidable(agent, delay_ms, now_ns)
        needs = self._needs(agent, kind)
        found = factors(delay_ms, error_cm, needs)
        error = needs.target - math.prod(found)
        if self._config.attribution and error > 0:
            error *= found.blame
        state = self._states.get(agent, pid.State(self._gains.rate_max_hz))
        self._states[agent] = pid.step(state, error, now_ns, self._gains)
        return self._states[agent].rate_hz

    def forget(self, agent: str) -> None:
        self._states.pop(agent, None)
        self._bases.pop(agent, None)

    def _avoidable(self, agent: str, delay_ms: float, now_ns: int) -> float:
        """ms, without what of the least delay of late is beyond 20 ms."""
        base = self._bases[agent] = self._bases.get(agent, BaseDelay()).after(delay_ms, now_ns)
        return delay_ms - max(0.0, base.ms - DELAY_MS)

    def _needs(self, agent: str, kind: AgentKind) -> Needs:
        return Needs.of(self._config, kind, agent)


class Equal(Share):
    """As `Share`, but all are taken for headset wearers."""

    alike = True

    def _needs(self, agent: str, kind: AgentKind) -> Needs:
        return Needs.of(self._config, AgentKind.AR)


class Random(Share):
    """As `Share`, with gains drawn from 0 to twice what is set, by `random_seed`, the same for all agents."""

    def __init__(self, config: ControlConfig) -> None:
        super().__init__(config)
        kp, ki, kd = np.random.default_rng(config.random_seed).uniform(0.0, 2.0, 3).tolist()
        self._gains = dataclasses.replace(
            self._gains, kp=kp * config.kp, ki=ki * config.ki, kd=kd * config.kd
        )


POLICIES: dict[str, type[Policy]] = {
    "share": Share,
    "covins-g": CovinsG,
    "linear": Linear,
    "equal": Equal,
    "random": Random,
    "streamed": Streamed,
}
