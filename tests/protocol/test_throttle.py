"""What peers can cause at any rate is few, and nobody's is hidden by another's."""

from __future__ import annotations

import re

from helpers.model_edge import S

from share.protocol.edge_records import EventLog
from share.timing import Throttle


def test_a_burst_then_so_many_a_second_and_the_rest_is_counted() -> None:
    throttle = Throttle(1.0, 3.0)
    assert [throttle.admit("a", 0) for _ in range(5)] == [0, 0, 0, None, None]
    assert throttle.admit("a", S) == 2


def test_a_new_key_is_admitted_however_many_there_are() -> None:
    throttle = Throttle(1.0, 3.0)
    for k in range(600):
        throttle.admit(k, 0)
    for second in range(1, 100):
        for k in range(100):
            throttle.admit((second, k), second * S)
    assert throttle.admit("ann", 101 * S) == 0
    assert throttle.admit("ann", 101 * S) == 0


def test_keys_that_are_new_each_time_are_few() -> None:
    """For ten minutes, a thousand new ones a second: two a second, and those that share one limit."""
    throttle = Throttle(1.0, 3.0)
    let_through = sum(
        throttle.admit((second, k), second * S) is not None for second in range(600) for k in range(1000)
    )
    assert let_through < 512 + 64 + 3 * 600 + 10


def test_what_goes_on_and_on_is_written_once_a_minute() -> None:
    records = EventLog(0)
    written = [records.throttled_event(s * S, "reconnected", "eve", "sends again") for s in range(3600)]
    first, later = written[:300], written[600:]
    assert sum(r is not None for r in first) > 150
    assert sum(r is not None for r in later) <= 51


def test_nothing_that_is_held_back_is_forgotten() -> None:
    records, counted = EventLog(0), 0
    for k in range(36_000):
        if (record := records.throttled_event(k * S // 10, "reconnected", "eve", "sends again")) is not None:
            more = re.search(r"and (\d+) more", record.fields["reason"])
            counted += 1 + (int(more[1]) if more else 0)
    assert 36_000 - counted < 700  # of the last minute
