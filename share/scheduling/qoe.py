"""Quality of experience: what an agent's delay and error are worth to whom it serves.

QoE = exp(-beta P) (1 - exp(-gamma Q)): a penalty P for what is missed most, and what a quality Q gains, ever
less the more there is of it. Source: SHARE, IMWUT 10(3) 97, 2026; defaults and why:
docs/understand/scheduling.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from share.config import AgentQoe, ControlConfig
from share.types import AgentKind

ACCEPTED_DELAY_MS = 20.0  # d0: of lag, a headset's wearer notices no less
REFERENCE_ACCURACY = 1.0  # a0, 1/cm
MIN_ERROR_CM = 0.05  # no estimate is believed to be better
_MAX_EXPONENT = 700.0  # exp of it is still finite


@dataclass(frozen=True)
class QoeParameters:
    """Of one agent. form AR: beta in 1/ms, gamma in cm, theta without meaning; form ROBOT: beta in cm,
    gamma in ms, theta_ms > 0. target: the QoE that is aimed at. signed: P may be negative."""

    form: AgentKind
    beta: float
    gamma: float
    theta_ms: float
    target: float
    signed: bool = False

    @classmethod
    def from_config(cls, config: ControlConfig, kind: AgentKind, agent: str = "") -> QoeParameters:
        """What `config` says of this agent by name, and of its form where it says nothing."""
        override = config.agents.get(agent, AgentQoe())
        form = AgentKind(override.form or kind)
        ar = form is AgentKind.AR
        return cls(
            form,
            _or_default(override.beta, config.ar_beta if ar else config.robot_beta),
            _or_default(override.gamma, config.ar_gamma if ar else config.robot_gamma),
            _or_default(override.theta_ms, config.robot_theta_ms),
            _or_default(override.target, config.ar_target if ar else config.robot_target),
            config.signed_penalty,
        )


def accuracy(error_cm: float | None) -> float:
    """1/cm, at most 20. Without an estimate (None): a0, as of an error of 1 cm."""
    return REFERENCE_ACCURACY if error_cm is None else 1.0 / max(error_cm, MIN_ERROR_CM)


class QoeFactors(NamedTuple):
    """What is left of an experience by its delay, and by its error; their product is its QoE."""

    delay: float
    error: float

    @property
    def error_attribution(self) -> float:
        """How much of what is missing is the error's rather than the delay's: from -1, all is the delay's, to
        1, by their logarithms."""
        delay, error = (-math.log(max(math.exp(-_MAX_EXPONENT), min(1.0, factor))) for factor in self)
        return (error - delay) / (error + delay) if error + delay else 0.0


def qoe(delay_ms: float, error_cm: float | None, parameters: QoeParameters) -> float:
    """0 to 1, falling with both. With `needs.signed` it is the printed form, which has no upper bound.

    delay_ms: what the agent sees, round trip and processing of a keyframe, >= 0; error_cm: see `accuracy`.
    """
    return math.prod(qoe_factors(delay_ms, error_cm, parameters))


def qoe_factors(delay_ms: float, error_cm: float | None, parameters: QoeParameters) -> QoeFactors:
    """The two of `qoe`."""
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


def _or_default(override: float | None, default: float) -> float:
    return default if override is None else override
