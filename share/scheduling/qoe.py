"""Quality of experience (QoE) of an agent, from its delay and error.

QoE = exp(-beta P) (1 - exp(-gamma Q)): a penalty P, and a quality Q with diminishing returns. Source: SHARE,
IMWUT 10(3) 97, 2026; the defaults and their reasons: docs/understand/scheduling.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from share.config import AgentQoe, ControlConfig
from share.types import F64, AgentKind

ACCEPTED_DELAY_MS = 20.0  # d0: a headset wearer does not notice less
REFERENCE_ACCURACY = 1.0  # a0, 1/cm
MIN_ERROR_CM = 0.05  # smaller estimates count as this
_MAX_EXPONENT = 700.0  # exp of it is still finite
_NO_OVERRIDE = AgentQoe()


@dataclass(frozen=True)
class QoeParameters:
    """QoE parameters of one agent. Form AR: beta in 1/ms, gamma in cm, theta_ms unused; form ROBOT: beta in
    cm, gamma in ms, theta_ms > 0. target: Q*. signed: P may be negative."""

    form: AgentKind
    beta: float
    gamma: float
    theta_ms: float
    target: float
    signed: bool = False

    @classmethod
    def from_config(cls, config: ControlConfig, kind: AgentKind, agent: str = "") -> QoeParameters:
        """Return the parameters of an agent: its entry in `control.agents`, else the defaults of its form."""
        override = config.agents.get(agent, _NO_OVERRIDE)
        form = AgentKind(override.form or kind)
        if form is AgentKind.AR:
            defaults = (config.ar_beta, config.ar_gamma, config.robot_theta_ms, config.ar_target)
        else:
            defaults = (config.robot_beta, config.robot_gamma, config.robot_theta_ms, config.robot_target)
        own = (override.beta, override.gamma, override.theta_ms, override.target)
        beta, gamma, theta_ms, target = (b if a is None else a for a, b in zip(own, defaults, strict=True))
        return cls(form, beta, gamma, theta_ms, target, config.signed_penalty)


def accuracy(error_cm: float | None) -> float:
    """Return the accuracy a, 1/cm, at most 20. error_cm None (unknown): a0."""
    return REFERENCE_ACCURACY if error_cm is None else 1.0 / max(error_cm, MIN_ERROR_CM)


class QoeFactors(NamedTuple):
    """The factors of a QoE due to delay and to error; their product is the QoE."""

    delay: float
    error: float

    @property
    def error_attribution(self) -> float:
        """Share of the QoE deficit due to error rather than delay, by logarithms: -1 all delay, 1 all
        error."""
        delay, error = (-math.log(max(math.exp(-_MAX_EXPONENT), min(1.0, factor))) for factor in self)
        return (error - delay) / (error + delay) if error + delay else 0.0


def qoe(delay_ms: float, error_cm: float | None, parameters: QoeParameters) -> float:
    """Return the QoE, 0 to 1, decreasing in both. With `parameters.signed` it has no upper bound.

    delay_ms: as in `Evaluation`, >= 0. error_cm: as in `accuracy`.
    """
    return math.prod(qoe_factors(delay_ms, error_cm, parameters))


def qoe_factors(delay_ms: float, error_cm: float | None, parameters: QoeParameters) -> QoeFactors:
    """Return the two factors of `qoe`."""
    if parameters.form is AgentKind.AR:
        penalty, quality = delay_ms - ACCEPTED_DELAY_MS, accuracy(error_cm)
    else:
        penalty, quality = REFERENCE_ACCURACY - accuracy(error_cm), 1.0 / (delay_ms + parameters.theta_ms)
    if not parameters.signed:
        penalty = max(0.0, penalty)
    penalty_factor = math.exp(min(_MAX_EXPONENT, -parameters.beta * penalty))
    quality_factor = -math.expm1(-parameters.gamma * quality)
    return (
        QoeFactors(penalty_factor, quality_factor)
        if parameters.form is AgentKind.AR
        else QoeFactors(quality_factor, penalty_factor)
    )


@dataclass(frozen=True, eq=False)
class QoeTable:
    """QoE parameters of N agents, as in `QoeParameters`."""

    is_ar: NDArray[np.bool_]
    beta: F64
    gamma: F64
    theta_ms: F64
    lowest_penalty: F64

    @classmethod
    def of(cls, parameters: Sequence[QoeParameters]) -> QoeTable:
        return cls(
            np.array([one.form is AgentKind.AR for one in parameters], bool),
            np.array([one.beta for one in parameters]),
            np.array([one.gamma for one in parameters]),
            np.array([one.theta_ms for one in parameters]),
            np.array([-np.inf if one.signed else 0.0 for one in parameters]),
        )

    def qoe(self, delay_ms: F64, error_cm: F64) -> F64:
        """Return `qoe` of each agent (N,). error_cm NaN: unknown."""
        return self.delay_factor(delay_ms) * self.error_factor(error_cm)

    def delay_factor(self, delay_ms: F64) -> F64:
        """Return the factor of the QoE due to delay of each agent (..., N)."""
        if self._are_all_ar:
            return self._penalty_factor(delay_ms - ACCEPTED_DELAY_MS)
        quality = self._quality_factor(1.0 / (delay_ms + self.theta_ms))
        if self._are_all_robots:
            return quality
        return np.where(self.is_ar, self._penalty_factor(delay_ms - ACCEPTED_DELAY_MS), quality)

    def error_factor(self, error_cm: F64) -> F64:
        """Return the factor of the QoE due to error of each agent (..., N). error_cm NaN: unknown."""
        accuracy = 1.0 / np.maximum(error_cm, MIN_ERROR_CM)
        accuracy = np.where(np.isnan(accuracy), REFERENCE_ACCURACY, accuracy)
        penalty = self._penalty_factor(REFERENCE_ACCURACY - accuracy)
        return np.where(self.is_ar, self._quality_factor(accuracy), penalty)

    @cached_property
    def _are_all_ar(self) -> bool:
        return bool(self.is_ar.all())

    @cached_property
    def _are_all_robots(self) -> bool:
        return not self.is_ar.any()

    def _penalty_factor(self, penalty: F64) -> F64:
        exponent = -self.beta * np.maximum(penalty, self.lowest_penalty)
        out: F64 = np.exp(np.minimum(exponent, _MAX_EXPONENT))
        return out

    def _quality_factor(self, quality: F64) -> F64:
        out: F64 = -np.expm1(-self.gamma * quality)
        return out
