"""PID controller: steps worked out by hand, and bounds. Base delay of an agent."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from share.config import ControlConfig
from share.scheduling.base_delay import BaseDelay
from share.scheduling.policies import GAP_S, PidState, pid_step

GAINS = ControlConfig(kp=0.8, ki=0.15, kd=0.2, rate_min_hz=0.5, rate_max_hz=10)
MINUTE = 60_000_000_000
S = 1_000_000_000


def close(state: PidState, expected: PidState) -> None:
    for name in ("rate_hz", "error", "integral_hz", "derivative", "updated_ns"):
        assert getattr(state, name) == pytest.approx(getattr(expected, name), abs=1e-12, rel=0)


def test_three_steps_by_hand() -> None:
    first = pid_step(PidState(5.0), 0.5, 0, GAINS)
    close(first, PidState(5.4, 0.5, 0.0, 0.0, 0))  # P 0.4
    second = pid_step(first, 0.25, S // 2, GAINS)
    # P 0.2; I 0.15 * 0.25 * 0.5 = 0.01875; slope 0.3 * -0.5 = -0.15, D -0.03
    close(second, PidState(5.58875, 0.25, 0.01875, -0.15, S // 2))
    third = pid_step(second, -0.25, S // 2 + S, GAINS)
    # P -0.2; I 0.01875 - 0.0375; slope 0.3 * -0.5 + 0.7 * -0.15 = -0.255, D -0.051
    close(third, PidState(5.319, -0.25, -0.01875, -0.255, S // 2 + S))


@pytest.mark.parametrize("later_ns", [0, -S, 5 * S + 1])
def test_without_a_valid_interval_the_derivative_is_reset_and_the_integral_held(
    later_ns: int,
) -> None:
    state = pid_step(PidState(5.0, 0.5, 0.05, -0.3, S), 0.25, S + later_ns, GAINS)
    close(state, PidState(5.25, 0.25, 0.05, 0.0, S + later_ns))  # P 0.2, I 0.05


def test_a_step_of_gap_s_is_no_gap() -> None:
    assert pid_step(PidState(5.0, 0.5, 0.0, 0.0, 0), 0.1, 5 * S, GAINS).derivative == pytest.approx(-0.024)


def test_the_integral_does_not_wind_up() -> None:
    state = PidState(5.0)
    for second in range(1000):
        state = pid_step(state, 1.0, second * S, GAINS)
    assert (state.rate_hz, state.integral_hz) == (10.0, 0.1)
    for second in range(1000, 1003):
        state = pid_step(state, -0.5, second * S, GAINS)
    assert state.integral_hz < 0 and state.rate_hz < 10


def test_the_rate_is_clipped_on_either_side() -> None:
    assert pid_step(PidState(9.9), 1.0, 0, GAINS).rate_hz == 10
    assert pid_step(PidState(0.6), -1.0, 0, GAINS).rate_hz == 0.5


@given(
    st.lists(st.tuples(st.floats(-5, 1), st.integers(-S, 20 * S)), min_size=1, max_size=30),
    st.floats(0, 50),
)
def test_rate_and_integral_stay_within_bounds(steps: list[tuple[float, int]], gain: float) -> None:
    gains = replace(GAINS, kp=gain, ki=gain, kd=gain)
    state, now_ns = PidState(10.0), 0
    for error, passed_ns in steps:
        now_ns += passed_ns
        state = pid_step(state, error, now_ns, gains)
        assert 0.5 <= state.rate_hz <= 10 and abs(state.integral_hz) <= 0.1
        assert (state.error, state.updated_ns) == (error, now_ns)


def test_the_lowest_rate_evaluates_more_often_than_a_gap() -> None:
    """Otherwise the slowest agent would never have a derivative or an integral."""
    assert 1 / ControlConfig().rate_min_hz < GAP_S


def test_base_delay_is_the_minimum_of_ten_minutes() -> None:
    base = BaseDelay()
    assert base.ms == float("inf")
    for minute, delay_ms in enumerate([30, 12, 50, 40, 60]):
        base = base.with_delay(delay_ms, minute * MINUTE)
    assert base.ms == 12
    assert base.with_delay(70, 10 * MINUTE).ms == 12
    assert base.with_delay(70, 11 * MINUTE).ms == 40
    assert base.with_delay(70, 60 * MINUTE).ms == 70


@given(st.lists(st.tuples(st.integers(0, 10**13), st.floats(0, 1e6))))
def test_base_delay_is_at_most_the_newest_and_its_memory_is_bounded(steps: list[tuple[int, float]]) -> None:
    base, now = BaseDelay(), 0
    for passed_ns, delay_ms in steps:
        now += passed_ns
        base = base.with_delay(delay_ms, now)
        assert base.ms <= delay_ms and len(base.minima) <= 10
