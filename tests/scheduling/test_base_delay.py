"""What of a delay is always there."""

from hypothesis import given
from hypothesis import strategies as st

from share.scheduling.policies import BaseDelay

MINUTE = 60_000_000_000


def test_the_least_of_ten_minutes() -> None:
    base = BaseDelay()
    assert base.ms == float("inf")
    for minute, delay_ms in enumerate([30, 12, 50, 40, 60]):
        base = base.with_delay(delay_ms, minute * MINUTE)
    assert base.ms == 12
    assert base.with_delay(70, 10 * MINUTE).ms == 12
    assert base.with_delay(70, 11 * MINUTE).ms == 40
    assert base.with_delay(70, 60 * MINUTE).ms == 70


@given(st.lists(st.tuples(st.integers(0, 10**13), st.floats(0, 1e6))))
def test_never_above_what_was_just_heard_and_never_long(said: list[tuple[int, float]]) -> None:
    base, now = BaseDelay(), 0
    for passed_ns, delay_ms in said:
        now += passed_ns
        base = base.with_delay(delay_ms, now)
        assert base.ms <= delay_ms and len(base.minima) <= 10
