"""The window of unacknowledged keyframes."""

from hypothesis import given
from hypothesis import strategies as st

from share.protocol.keyframe_pace import MAX_KEYFRAMES, KeyframeWindow

S = 1_000_000_000


def sizes(acks_ms: list[float]) -> list[int]:
    window, out = KeyframeWindow(), []
    for k, ack_ms in enumerate(acks_ms):
        window.acknowledge(ack_ms, k * S)
        out.append(window.size)
    return out


def test_it_begins_with_one_and_grows_with_each_acknowledgement_in_time() -> None:
    assert KeyframeWindow().size == 1
    assert sizes([60.0] * 4) == [2, 3, 3, 3]


def test_a_late_acknowledgement_halves_it_and_timely_ones_bring_it_back() -> None:
    assert sizes([60, 60, 60, 400, 400, 60, 60]) == [2, 3, 3, 1, 1, 2, 3]


def test_a_long_way_to_the_edge_is_not_late() -> None:
    assert sizes([600.0, 650.0, 620.0]) == [2, 3, 3]


def test_after_ten_minutes_on_a_slower_network_its_delay_is_no_longer_late() -> None:
    window = KeyframeWindow()
    window.acknowledge(20.0, 0)
    for minute in range(1, 13):
        window.acknowledge(300.0, minute * 60 * S)
    assert window.size > 1


@given(st.lists(st.floats(0, 1e7), max_size=50))
def test_it_stays_within_bounds(acks_ms: list[float]) -> None:
    assert all(1 <= size <= MAX_KEYFRAMES for size in sizes(acks_ms))
