"""When agents that begin together send their first keyframe."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from share.scheduling.staggered_start import MAX_HOLD_S, UNKNOWN_KEYFRAME_S, StaggeredStart
from share.wire.messages import MAX_HOLD_MS

S = 1_000_000_000


def test_who_begins_alone_begins_at_once() -> None:
    start = StaggeredStart()
    assert [start.hold_ms(None, k * S) for k in range(5)] == [0.0] * 5


def test_who_begin_together_take_turns_as_long_as_a_keyframe() -> None:
    start = StaggeredStart()
    unknown_ms = 1e3 * UNKNOWN_KEYFRAME_S
    assert [start.hold_ms(None, S) for _ in range(3)] == pytest.approx([0.0, unknown_ms, 2 * unknown_ms])
    known = StaggeredStart()
    assert [known.hold_ms(0.034, S) for _ in range(3)] == pytest.approx([0.0, 34.0, 68.0])
    assert known.hold_ms(0.034, 2 * S) == 0.0


@given(st.lists(st.tuples(st.none() | st.floats(0, 1e9), st.integers(0, 10 * S)), max_size=50))
def test_nobody_waits_long(begun: list[tuple[float | None, int]]) -> None:
    start, now_ns = StaggeredStart(), 0
    for keyframe_s, passed_ns in begun:
        now_ns += passed_ns
        assert 0 <= start.hold_ms(keyframe_s, now_ns) <= 1e3 * MAX_HOLD_S <= MAX_HOLD_MS
