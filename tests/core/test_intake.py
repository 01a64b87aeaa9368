"""Samples of a device to one time that goes forward, and what is counted on the way."""

from __future__ import annotations

import itertools

import pytest

from share.core.gaps import Gaps
from share.core.intake import Intake, Sample
from share.core.stamps import WRAP_NS

MS = 10**6
RATES = {"cam0": 30.0, "accel": 250.0, "gyro": 400.0}


def stamps(intake: Intake, *samples: Sample) -> list[int]:
    return [measurement.stamp_ns for sample in samples for measurement in intake.feed(sample)]


def image(stamp_ns: int, arrived_ns: int = 0, **more: int) -> Sample:
    return Sample("cam0", stamp_ns, None, arrived_ns, **more)


def test_time_goes_on_over_a_wrap() -> None:
    intake = Intake(RATES, 10.0)
    assert stamps(intake, image(WRAP_NS - 10 * MS), image(20 * MS)) == [WRAP_NS - 10 * MS, WRAP_NS + 20 * MS]
    assert intake.counts()["wraps"] == 1


def test_a_clock_that_began_anew_goes_on_as_far_as_the_hosts_did() -> None:
    intake = Intake(RATES, 10.0)
    told = stamps(
        intake,
        image(900 * MS, arrived_ns=5000 * MS),
        image(3 * MS, arrived_ns=7000 * MS, epoch=1),
        image(36 * MS, arrived_ns=7030 * MS, epoch=1),
    )
    assert told == [900 * MS, 2900 * MS, 2933 * MS]
    assert intake.stretches == 2


def test_stamps_of_another_clock_are_used_and_counted() -> None:
    intake = Intake(RATES, 10.0)
    assert stamps(intake, Sample("cam0", MS, None, 0, hardware=False)) == [MS]
    assert intake.counts()["foreign"] == 1


def test_a_stream_that_was_not_asked_for_is_left_out() -> None:
    intake = Intake({"cam0": 30.0}, 10.0)
    assert stamps(intake, Sample("gyro", MS, (0, 0, 0), 0), image(2 * MS)) == [2 * MS]


@pytest.mark.parametrize("numbered", [True, False])
def test_what_is_missing_is_known_by_number_or_by_rate(numbered: bool) -> None:
    gaps = Gaps(10.0)
    for k in (0, 1, 2, 6, 7, 9):
        assert gaps.feed(k * 100 * MS, k if numbered else None)
    assert (gaps.samples, gaps.gaps, gaps.missing, gaps.seconds) == (6, 2, 4, 0.9)


def test_late_and_double_samples_are_refused() -> None:
    gaps = Gaps(10.0)
    assert [gaps.feed(stamp * MS) for stamp in (100, 200, 200, 150, 300)] == [True, True, False, False, True]
    assert (gaps.backward, gaps.missing) == (2, 0)


def test_a_camera_that_numbers_anew_has_not_lost_frames() -> None:
    gaps = Gaps(10.0)
    for stamp, number in ((0, 500), (100, 0), (200, 1)):
        gaps.feed(stamp * MS, number)
    assert gaps.missing == 0


def fed(intake: Intake, stream: str, begin_ms: int, count: int, arrived_ms: int) -> list[int]:
    """Stamps in ms that come of `count` samples, one every 5 ms."""
    told = []
    for k in range(0, 5 * count, 5):
        at = Sample(stream, (begin_ms + k) * MS, (0, 0, 0), (arrived_ms + k) * MS)
        told += [stamp // MS for stamp in stamps(intake, at)]
    return told


@pytest.mark.parametrize("before_ms", [900_000, 3_000])
def test_a_clock_that_begins_anew_without_a_word_is_noticed(before_ms: int) -> None:
    intake = Intake(RATES, 10.0)
    assert fed(intake, "cam0", before_ms, 100, 7_000)[-1] == before_ms + 495
    told = fed(intake, "cam0", 0, 100, 7_500)
    assert told[0] == pytest.approx(before_ms + 500 + 250, abs=10)  # 0.25 s are the price of being sure
    assert [b - a for a, b in itertools.pairwise(told)] == [5] * (len(told) - 1)
    assert len(told) == 100 - 51
    assert (intake.restarts, intake.stretches) == (1, 2)


def test_late_and_doubled_samples_are_no_new_clock() -> None:
    intake = Intake(RATES, 10.0)
    fed(intake, "cam0", 10_000, 100, 0)
    for again in range(20):  # the same 40 ms twenty times: doubled, not a clock
        assert fed(intake, "cam0", 10_200, 8, 500 + 40 * again) == []
    assert fed(intake, "cam0", 9_000, 40, 1500) == []  # 0.2 s late
    assert fed(intake, "cam0", 10_500, 2, 2000) == [10_500, 10_505]
    assert (intake.restarts, intake.stretches) == (0, 1)
