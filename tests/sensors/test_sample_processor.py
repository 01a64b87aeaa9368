"""A device's samples get one time that only goes forward; repairs and losses are counted."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from share.sensors.sample_processor import DeviceSample, SampleProcessor
from share.sensors.stamps import WRAP_NS, GapCounter

MS = 10**6
RATES = {"cam0": 30.0, "accel": 250.0, "gyro": 400.0}


def stamps(intake: SampleProcessor, *samples: DeviceSample) -> list[int]:
    return [measurement.stamp_ns for sample in samples for measurement in intake.feed(sample)]


def image(stamp_ns: int, arrived_ns: int = 0, **more: int) -> DeviceSample:
    return DeviceSample("cam0", stamp_ns, None, arrived_ns, **more)


def test_a_wrapping_clock_is_unwrapped() -> None:
    intake = SampleProcessor(RATES)
    assert stamps(intake, image(WRAP_NS - 10 * MS), image(20 * MS)) == [WRAP_NS - 10 * MS, WRAP_NS + 20 * MS]
    assert intake.counts()["wraps"] == 1


def test_after_a_reconnection_time_advances_as_the_hosts_clock_did() -> None:
    intake = SampleProcessor(RATES)
    told = stamps(
        intake,
        image(900 * MS, arrived_ns=5000 * MS),
        image(3 * MS, arrived_ns=7000 * MS, epoch=1),
        image(36 * MS, arrived_ns=7030 * MS, epoch=1),
    )
    assert told == [900 * MS, 2900 * MS, 2933 * MS]
    assert intake.segments == 2


def test_samples_from_before_a_reconnection_are_dropped() -> None:
    intake = SampleProcessor(RATES)
    told = stamps(
        intake,
        image(900 * MS, arrived_ns=5000 * MS),
        image(3 * MS, arrived_ns=7000 * MS, epoch=1),
        image(933 * MS, arrived_ns=7001 * MS),
        image(36 * MS, arrived_ns=7030 * MS, epoch=1),
    )
    assert told == [900 * MS, 2900 * MS, 2933 * MS]
    assert intake.segments == 2


HOST_NS = 1_760_000_000_000 * MS  # of the host's clock


def foreign(at_ms: int, stream: str = "cam0") -> DeviceSample:
    return DeviceSample(stream, HOST_NS + at_ms * MS, (0, 0, 0), at_ms * MS, is_device_clock=False)


def of_imu(at_ms: int, stream: str = "gyro", epoch: int = 0, off_ms: int = 0) -> DeviceSample:
    """Return a sample whose clock is `off_ms` ahead of its arrival."""
    return DeviceSample(stream, (at_ms + off_ms) * MS, (0, 0, 0), at_ms * MS, epoch=epoch)


def test_without_a_device_clock_the_hosts_is_used() -> None:
    intake = SampleProcessor(RATES)
    assert stamps(intake, *(foreign(at) for at in range(0, 1001, 100))) == []
    assert stamps(intake, foreign(1100)) == [HOST_NS + at * MS for at in range(0, 1101, 100)]
    assert stamps(intake, foreign(1200)) == [HOST_NS + 1200 * MS]
    assert (intake.counts()["foreign"], intake.segments) == (13, 1)
    assert not any(intake.placed_by_arrival.values())


def test_a_short_recording_by_the_hosts_clock_is_flushed_at_its_end() -> None:
    intake = SampleProcessor(RATES)
    assert stamps(intake, foreign(0), foreign(33)) == []
    assert [m.stamp_ns - HOST_NS for m in intake.flush()] == [0, 33 * MS]
    assert list(intake.flush()) == []


def test_host_stamped_images_are_placed_by_arrival_among_imu_samples() -> None:
    intake, images, imu = SampleProcessor(RATES | {"cam1": 30.0}), [], []
    for at in range(4000):
        more = [foreign(at), foreign(at, "cam1")] if at % 33 == 0 else []
        for sample in (*more, of_imu(at, "accel", off_ms=5000), of_imu(at, off_ms=5000)):
            for m in intake.feed(sample):
                (imu if m.stream == "imu" else images).append((m.stream, m.stamp_ns // MS))
    assert [stamp for _, stamp in imu] == list(range(5000, 9000))
    assert images == [(cam, 5000 + at) for at in range(33, 4000, 33) for cam in ("cam0", "cam1")]
    counts = intake.counts()
    assert (counts["jumps"], counts["past"], counts["restarts"], intake.segments) == (0, 0, 0, 1)
    assert (intake.placed_by_arrival["cam0"], intake.placed_by_arrival["gyro"], counts["foreign"]) == (
        121,
        0,
        244,
    )


def test_a_few_host_stamped_images_do_not_shift_the_others() -> None:
    intake, told = SampleProcessor({"cam0": 30.0}), []
    for k in range(3000):
        at = 33 * k
        told += stamps(intake, foreign(at) if k % 500 > 497 else of_imu(at, "cam0", off_ms=70_000))
    assert told == [(70_000 + 33 * k) * MS for k in range(3000)]
    assert (intake.streams["cam0"].missing, intake.restarts, intake.segments) == (0, 0, 1)


def test_a_late_device_clock_takes_over() -> None:
    intake = SampleProcessor(RATES)
    stamps(intake, *(foreign(at) for at in range(0, 2001, 100)))
    assert stamps(intake, of_imu(2050, "cam0"), foreign(2100)) == [HOST_NS + 2050 * MS, HOST_NS + 2100 * MS]
    assert intake.placed_by_arrival["cam0"] == 1


def test_after_a_reconnection_host_stamped_images_do_not_wait() -> None:
    intake = SampleProcessor(RATES)
    told = stamps(
        intake,
        of_imu(100, "cam0", off_ms=900),
        replace(foreign(3000), epoch=1),
        of_imu(3050, "cam0", epoch=1, off_ms=-3000),
    )
    assert told == [1000 * MS, 3900 * MS, 3950 * MS]
    assert intake.segments == 2


def test_an_unexpected_stream_is_dropped() -> None:
    intake = SampleProcessor({"cam0": 30.0})
    assert stamps(intake, DeviceSample("gyro", MS, (0, 0, 0), 0), image(2 * MS)) == [2 * MS]


@pytest.mark.parametrize("numbered", [True, False])
def test_missing_samples_are_counted_by_frame_number_or_rate(numbered: bool) -> None:
    gaps = GapCounter(10.0)
    for k in (0, 1, 2, 6, 7, 9):
        assert gaps.feed(k * 100 * MS, k if numbered else None)
    assert (gaps.samples, gaps.gaps, gaps.missing, gaps.seconds) == (6, 2, 4, 0.9)


def test_late_and_repeated_samples_are_refused() -> None:
    gaps = GapCounter(10.0)
    assert [gaps.feed(stamp * MS) for stamp in (100, 200, 200, 150, 300)] == [True, True, False, False, True]
    assert (gaps.backward, gaps.missing) == (2, 0)


def test_restarted_frame_numbers_are_no_loss() -> None:
    gaps = GapCounter(10.0)
    for stamp, number in ((0, 500), (100, 0), (200, 1)):
        gaps.feed(stamp * MS, number)
    assert gaps.missing == 0


def fed(intake: SampleProcessor, stream: str, begin_ms: int, count: int, arrived_ms: int) -> list[int]:
    """Return the stamps, ms, of `count` samples, one every 5 ms."""
    told = []
    for k in range(0, 5 * count, 5):
        at = DeviceSample(stream, (begin_ms + k) * MS, (0, 0, 0), (arrived_ms + k) * MS)
        told += [stamp // MS for stamp in stamps(intake, at)]
    return told


@pytest.mark.parametrize("before_ms", [900_000, 3_000])
def test_an_unannounced_clock_restart_is_detected(before_ms: int) -> None:
    intake = SampleProcessor(RATES)
    assert fed(intake, "cam0", before_ms, 100, 7_000)[-1] == before_ms + 495
    told = fed(intake, "cam0", 0, 100, 7_500)
    assert told[0] == pytest.approx(before_ms + 500 + 250, abs=10)  # 0.25 s are the price of being sure
    assert [b - a for a, b in itertools.pairwise(told)] == [5] * (len(told) - 1)
    assert len(told) == 100 - 51
    assert (intake.restarts, intake.segments) == (1, 2)


def test_late_and_repeated_samples_are_no_clock_restart() -> None:
    intake = SampleProcessor(RATES)
    fed(intake, "cam0", 10_000, 100, 0)
    for again in range(20):  # the same 40 ms twenty times: doubled, not a clock
        assert fed(intake, "cam0", 10_200, 8, 500 + 40 * again) == []
    assert fed(intake, "cam0", 9_000, 40, 1500) == []  # 0.2 s late
    assert fed(intake, "cam0", 10_500, 2, 2000) == [10_500, 10_505]
    assert (intake.restarts, intake.segments) == (0, 1)
