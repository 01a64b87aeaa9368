"""PID controller of an agent's keyframe rate, one step per evaluation.

    e = Q* - Q;  P = Kp e;  I = clip(I + Ki e dt, +-I_max)
    d = alpha (e - e_prev)/dt + (1 - alpha) d_prev;  D = Kd d
    R = clip(R_prev + P + I + D, R_min, R_max)

Source: SHARE, IMWUT 10(3) 97, 2026. Filtered derivative and bounded integral: Astrom and Hagglund,
*Advanced PID Control* (2006). Each step adds to R, so a persistent error drives the rate to a bound.
"""

from __future__ import annotations

from dataclasses import dataclass

from share.config import ControlConfig


@dataclass(frozen=True)
class PidGains:
    """kp Hz, ki Hz/s, kd Hz s, per unit of QoE; alpha 0 .. 1; a dt above gap_s is a gap."""

    kp: float
    ki: float
    kd: float
    alpha: float
    integral_max_hz: float
    rate_min_hz: float
    rate_max_hz: float
    gap_s: float

    @classmethod
    def from_config(cls, config: ControlConfig) -> PidGains:
        return cls(**{name: getattr(config, name) for name in cls.__dataclass_fields__})


@dataclass(frozen=True)
class PidState:
    """State of one agent after an evaluation. integral_hz: I. derivative: d, 1/s. updated_ns: time of the
    evaluation; None before the first."""

    rate_hz: float
    error: float = 0.0
    integral_hz: float = 0.0
    derivative: float = 0.0
    updated_ns: int | None = None


def step(state: PidState, error: float, now_ns: int, gains: PidGains) -> PidState:
    """Return the state after an evaluation at `now_ns`. error: target minus QoE, finite.

    The first evaluation, one with dt <= 0 and one after a gap have no derivative: d = 0, I is held.
    """
    dt = 0.0 if state.updated_ns is None else (now_ns - state.updated_ns) / 1e9
    integral, derivative = state.integral_hz, 0.0
    if 0 < dt <= gains.gap_s:
        integral = _clip(integral + gains.ki * error * dt, -gains.integral_max_hz, gains.integral_max_hz)
        derivative = gains.alpha * (error - state.error) / dt + (1 - gains.alpha) * state.derivative
    rate = state.rate_hz + gains.kp * error + integral + gains.kd * derivative
    return PidState(_clip(rate, gains.rate_min_hz, gains.rate_max_hz), error, integral, derivative, now_ns)


def _clip(value: float, low: float, high: float) -> float:
    return min(high, max(low, value))
