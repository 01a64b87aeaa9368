"""The four stamps, by hand and between simulated clocks whose truth is known."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from share.protocol.edge_clock import Exchange

SPANS = st.integers(0, 10**10)


@pytest.mark.parametrize(
    ("stamps", "offset", "delay"),
    [
        ((0, 0, 0, 0), 0, 0),
        ((1000, 5400, 5500, 1900), 4000, 800),  # there 400, back 400, kept 100
        ((100, 140, 150, 160), 15, 50),  # same clock, there 40, back 10: half of 30
        ((100, 110, 120, 160), -15, 50),  # the reverse
        ((10**18, 10**18 - 7 * 10**9, 10**18 - 7 * 10**9, 10**18 + 6), -7 * 10**9 - 3, 6),
        ((0, 1, 1, 1), 0, 1),  # half a ns, rounded down
    ],
)
def test_offset_and_delay_by_hand(stamps: tuple[int, int, int, int], offset: int, delay: int) -> None:
    exchange = Exchange(*stamps)
    assert (exchange.offset_ns, exchange.delay_ns) == (offset, delay)
    assert exchange.is_valid


@given(st.integers(-(10**19), 10**19), SPANS, SPANS, SPANS)
def test_the_true_offset_is_within_half_the_delay(true: int, there: int, kept: int, back: int) -> None:
    sent = 1_795_446_605 * 10**9
    arrived = sent + there
    exchange = Exchange(sent, arrived + true, arrived + kept + true, arrived + kept + back)
    assert exchange.delay_ns == there + back
    assert exchange.offset_ns - true == (there - back) // 2
    assert 2 * abs(exchange.offset_ns - true) <= exchange.delay_ns + 1


@pytest.mark.parametrize("stamps", [(0, 5, 5, -1), (0, 5, 4, 9), (0, 0, 10, 9)])
def test_clocks_that_were_set_meanwhile_are_noticed(stamps: tuple[int, int, int, int]) -> None:
    assert not Exchange(*stamps).is_valid
