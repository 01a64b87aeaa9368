"""When agents that begin together send their first keyframe."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from share.config import ControlConfig
from share.scheduling.qoe import QoeParameters
from share.scheduling.room_controller import (
    MAX_HOLD_S,
    UNKNOWN_KEYFRAME_S,
    AirtimeMeasurement,
    RoomController,
    StaggeredStart,
)
from share.types import AgentKind
from share.wire.messages import MAX_HOLD_MS, Evaluation

S = 1_000_000_000


def test_who_begins_alone_begins_at_once() -> None:
    start = StaggeredStart()
    assert [start.hold_ms(UNKNOWN_KEYFRAME_S, k * S) for k in range(5)] == [0.0] * 5


def test_who_begin_together_take_turns_as_long_as_a_keyframe() -> None:
    known = StaggeredStart()
    assert [known.hold_ms(0.034, S) for _ in range(3)] == pytest.approx([0.0, 34.0, 68.0])
    assert known.hold_ms(0.034, 2 * S) == 0.0


@given(st.lists(st.tuples(st.floats(0, 1e9), st.integers(0, 10 * S)), max_size=50))
def test_nobody_waits_long(begun: list[tuple[float, int]]) -> None:
    start, now_ns = StaggeredStart(), 0
    for keyframe_s, passed_ns in begun:
        now_ns += passed_ns
        assert 0 <= start.hold_ms(keyframe_s, now_ns) <= 1e3 * MAX_HOLD_S <= MAX_HOLD_MS


def test_twelve_that_enter_an_empty_room_begin_within_a_third_of_a_second() -> None:
    """Their first keyframes have small pictures, and nobody is there whom they would make late."""
    room = RoomController()
    holds_ms = [room.hold_ms(f"ar{k}", S) for k in range(12)]
    assert holds_ms == pytest.approx([30.0 * k for k in range(12)])


def test_who_enter_a_room_where_others_are_leave_them_half_of_the_air() -> None:
    room, terms = RoomController(), QoeParameters.from_config(ControlConfig(), AgentKind.AR)
    told = Evaluation(0, 80.0, 1.0, 10.0, 5.0, 40.0, 0.5)
    room.grant("ar0", terms, 1.0, told, AirtimeMeasurement(40.0, 36.0, 1, 0), S)
    first_ms, second_ms = (room.hold_ms(name, S) for name in ("ar1", "ar2"))
    keyframe_ms = 1e3 * room._keyframe_s
    assert (first_ms, second_ms) == pytest.approx((0.0, 2 * keyframe_ms)) and 20 < keyframe_ms < 60
