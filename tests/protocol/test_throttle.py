"""Limits on events and lines that a peer can cause at any rate."""

from __future__ import annotations

import re

import pytest
from helpers.model_edge import S

from share.protocol.edge_records import EventLog
from share.timing import LineLimiter, Throttle


def test_a_burst_passes_then_the_rate_and_the_rest_is_counted() -> None:
    throttle = Throttle(1.0, 3.0)
    assert [throttle.admit("a", 0) for _ in range(5)] == [0, 0, 0, None, None]
    assert throttle.admit("a", S) == 2


def test_a_new_key_is_admitted_whatever_their_number() -> None:
    throttle = Throttle(1.0, 3.0)
    for k in range(600):
        throttle.admit(k, 0)
    for second in range(1, 100):
        for k in range(100):
            throttle.admit((second, k), second * S)
    assert throttle.admit("ann", 101 * S) == 0
    assert throttle.admit("ann", 101 * S) == 0


@pytest.mark.long
def test_ever_new_keys_are_limited() -> None:
    """A thousand new keys a second for ten minutes: two a second pass, and those that share one limit."""
    throttle = Throttle(1.0, 3.0)
    let_through = sum(
        throttle.admit((second, k), second * S) is not None for second in range(600) for k in range(1000)
    )
    assert let_through < 512 + 64 + 3 * 600 + 10


def test_a_lasting_event_is_written_once_a_minute() -> None:
    records = EventLog(0)
    written = [records.throttled_event(s * S, "reconnected", "eve", "sends again") for s in range(3600)]
    first, later = written[:300], written[600:]
    assert sum(r is not None for r in first) > 150
    assert sum(r is not None for r in later) <= 51


def test_suppressed_events_are_counted() -> None:
    records, counted = EventLog(0), 0
    for k in range(36_000):
        if (record := records.throttled_event(k * S // 10, "reconnected", "eve", "sends again")) is not None:
            more = re.search(r"and (\d+) more", record.fields["reason"])
            counted += 1 + (int(more[1]) if more else 0)
    assert 36_000 - counted < 700  # of the last minute


def test_a_fault_is_new_again_after_a_minute_of_absence() -> None:
    lines = LineLimiter()
    said = [t for t in range(0, 600, 2) if lines.admit_new("wants keys", t * S)]
    assert said == [0]
    assert not lines.admit_new("wants keys", 655 * S)
    assert lines.admit_new("another key", 656 * S)
    assert lines.admit_new("wants keys", 716 * S)
    assert not lines.admit_new("wants more keys", 716 * S, "another key")
    assert lines.admit_new("and one more", 718 * S, "a third")


def test_the_number_of_remembered_faults_is_bounded() -> None:
    lines = LineLimiter()
    assert all(lines.admit_new(str(k), k) for k in range(20))
    assert not lines.admit_new("19", 6 * S)
    assert lines.admit_new("0", 6 * S)  # forgotten, although it was seen less than a minute ago


def test_lines_are_limited_printable_and_short() -> None:
    lines = LineLimiter()
    said = [lines.admit(f"{k} \x1b[2J" + "x" * 1000, 0) for k in range(50)]
    assert [k for k, line in enumerate(said) if line is not None] == list(range(20))
    assert all(line.isprintable() and len(line) <= 300 for line in said[:20] if line)
    assert lines.admit("all is well", 5 * S) == "all is well (30 lines before this were suppressed)"
