"""Quality of experience: what an agent's delay and error are worth to whom it serves.

QoE = exp(-beta P) (1 - exp(-gamma Q)): a penalty P for what is missed most, and what a quality Q gains, ever
less the more there is of it. Source: SHARE, IMWUT 10(3) 97, 2026; defaults and why: docs/scheduling.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from share.config import AgentNeeds, ControlConfig
from share.types import AgentKind

DELAY_MS = 20.0  # d0: of lag, a headset's wearer notices no less
ACCURACY = 1.0  # a0, 1/cm
LEAST_ERROR_CM = 0.05  # no estimate is believed to be better
_MOST = 700.0  # exp of it is still finite


@dataclass(frozen=True)
class Needs:
    """Of one agent. form AR: beta in 1/ms, gamma in cm, theta without meaning; form ROBOT: beta in cm,
    gamma in ms, theta_ms > 0. target: the QoE that is aimed at. signed: P may be negative."""

    form: AgentKind
    beta: float
    gamma: float
    theta_ms: float
    target: float
    signed: bool = False

    @classmethod
    def of(cls, config: ControlConfig, kind: AgentKind, agent: str = "") -> Needs:
        """What `config` says of this agent by name, and of its form where it says nothing."""
        own = config.agents.get(agent, AgentNeeds())
        form = AgentKind(own.form or kind)
        ar = form is AgentKind.AR
        return cls(
            form,
            _first(own.beta, config.ar_beta if ar else config.robot_beta),
            _first(own.gamma, config.ar_gamma if ar else config.robot_gamma),
            _first(own.theta_ms, config.robot_theta_ms),
            _first(own.target, config.ar_target if ar else config.robot_target),
            config.signed_penalty,
        )


def accuracy(error_cm: float | None) -> float:
    """1/cm, at most 20. Without an estimate (None): a0, as of an error of 1 cm."""
    return ACCURACY if error_cm is None else 1.0 / max(error_cm, LEAST_ERROR_CM)


class Factors(NamedTuple):
    """What is left of an experience by its delay, and by its error; their product is its QoE."""

    delay: float
    error: float

    @property
    def blame(self) -> float:
        """How much of what is missing is the error's rather than the delay's: from -1, all is the delay's, to
        1, by their logarithms."""
        delay, error = (-math.log(max(math.exp(-_MOST), min(1.0, factor))) for factor in self)
        return (error - delay) / (error + delay) if error + delay else 0.0


def qoe(delay_ms: float, error_cm: float | None, needs: Needs) -> float:
    """0 to 1, falling with both. With `needs.signed` it is the printed form, which has no upper bound.

    delay_ms: what the agent sees, round trip and processing of a keyframe, >= 0; error_cm: see `accuracy`.
    """
    return math.prod(factors(delay_ms, error_cm, needs))


def factors(delay_ms: float, error_cm: float | None, needs: Needs) -> Factors:
    """The two of `qoe`."""
    if needs.form is AgentKind.AR:
        penalty, quality = delay_ms - DELAY_MS, accuracy(error_cm)
    else:
        penalty, quality = ACCURACY - accuracy(error_cm), 1.0 / (delay_ms + needs.theta_ms)
    if not needs.signed:
        penalty = max(0.0, penalty)
    missed = math.exp(min(_MOST, -needs.beta * penalty))
    gained = -math.expm1(-needs.gamma * quality)
    return Factors(missed, gained) if needs.form is AgentKind.AR else Factors(gained, missed)


def _first(own: float | None, usual: float) -> float:
    return usual if own is None else own
