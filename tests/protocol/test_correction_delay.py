"""The delay from a frame to the correction that answers it."""

from __future__ import annotations

import pytest

from share.protocol.correction_delay import ComputationDelay, CorrectionDelay

MS = 1_000_000


def served(delay: CorrectionDelay, keyframe: int, at_ms: int, ack_ms: int, corrected_ms: int | None) -> None:
    """A keyframe whose frame arrived at `at_ms`, sent 10 ms later."""
    delay.add_keyframe(keyframe, at_ms * MS)
    delay.mark_sent(keyframe, (at_ms + 10) * MS)
    delay.acknowledge(keyframe + 1, (at_ms + ack_ms) * MS)
    if corrected_ms is not None:
        delay.correct(keyframe, corrected_ms, (at_ms + corrected_ms) * MS)


def test_it_is_unknown_before_the_first_keyframe() -> None:
    assert CorrectionDelay().ms(10**9) is None
    assert CorrectionDelay().ack_ms(10**9) == 0


def test_it_is_the_time_until_the_correction() -> None:
    delay = CorrectionDelay()
    for k in range(5):
        served(delay, k, 1000 * k, 40, 75)
    assert delay.ms(4100 * MS) == pytest.approx(75)
    assert delay.ack_ms(4100 * MS) == pytest.approx(30)  # since it was sent


def test_a_keyframe_that_leads_to_no_correction_counts_by_its_acknowledgement() -> None:
    delay = CorrectionDelay()
    served(delay, 0, 0, 40, 75)
    for k in range(1, 8):
        served(delay, k, 1000 * k, 140, None)
    assert delay.ms(8000 * MS) == pytest.approx(140 + 35, abs=1)


def test_a_keyframe_that_nobody_acknowledges_is_as_late_as_it_is() -> None:
    delay = CorrectionDelay()
    served(delay, 0, 0, 40, 75)
    for k in (1, 2):
        delay.add_keyframe(k, 1000 * k * MS)
        delay.mark_sent(k, (1000 * k + 10) * MS)
    assert delay.ms(1020 * MS) == pytest.approx(75)
    assert delay.ms(4000 * MS) == pytest.approx(3000 + 35)
    assert delay.waiting_ms(4000 * MS) == pytest.approx(3000)
    assert delay.ack_ms(4000 * MS) == pytest.approx(2990)
    delay.acknowledge(3, 4000 * MS)
    assert delay.waiting_ms(4000 * MS) == 0
    assert delay.ms(4000 * MS) > 2000  # what has been so late is not forgotten at once


def test_it_follows_within_seconds() -> None:
    delay = CorrectionDelay()
    served(delay, 0, 0, 2000, None)
    for k in range(1, 5):
        served(delay, k, 2000 + 1000 * k, 40, None)
    assert delay.ms(6100 * MS) == pytest.approx(40, abs=60)


def test_the_edges_part_is_from_arrival_to_the_first_correction() -> None:
    part = ComputationDelay()
    assert part.ms == 0
    part.add_keyframe(7, 100 * MS)
    part.answer(7, 130 * MS)
    part.answer(7, 900 * MS)  # a later correction of the same keyframe
    part.answer(8, 900 * MS)  # never arrived
    assert part.ms == pytest.approx(30)


def test_the_edge_holds_acknowledgements_for_its_disk() -> None:
    part = ComputationDelay()
    for k in range(4):
        part.add_keyframe(k, 1000 * k * MS)
        part.acknowledge(k, (1000 * k + 1) * MS)  # of the earlier ones again
        part.acknowledge(k + 1, (1000 * k + 80) * MS)
    assert part.held_ms == pytest.approx(80)


def test_memory_is_bounded() -> None:
    delay, part = CorrectionDelay(), ComputationDelay()
    for k in range(5000):
        delay.add_keyframe(k, k * MS)
        delay.mark_sent(k, k * MS)
        part.add_keyframe(k, k * MS)
    assert len(delay._waiting) <= 1000 and len(delay._sent_ns) <= 1000 and len(part._received_ns) <= 64
    delay.acknowledge(5000, 6000 * MS)
    assert len(delay._acknowledged_ms) <= 64


def test_a_keyframe_that_is_acknowledged_before_it_is_sent_took_no_time() -> None:
    """It is held, and the edge says that it has it."""
    delay = CorrectionDelay()
    delay.add_keyframe(0, 0)
    assert delay.acknowledge(1, 10**9) == [0.0]
    delay.mark_sent(0, 10 * 10**9)
    assert delay.ack_ms(20 * 10**9) == 0.0


def test_what_a_keyframe_is_held_is_no_time_on_the_air() -> None:
    delay = CorrectionDelay()
    delay.add_keyframe(0, 0)
    assert delay.ack_ms(500 * MS) == 0.0
    delay.mark_sent(0, 550 * MS)
    assert delay.acknowledge(1, 560 * MS) == [10.0]
    assert delay.ms(560 * MS) == 560.0
