"""Frames at their arrival times, and those that come late."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.hellos import hello_of

from share.protocol.agent_events import AgentTick
from share.runtime.arrivals import (
    READ_AHEAD,
    LateFrameDropper,
    LatenessMonitor,
    LiveArrivals,
    RecordedArrivals,
    late_limit_ms,
)
from share.types import AgentKind, Frame, ImuBatch

_PATIENCE_S = 5.0
_WHILE_S = 0.3  # in which a thread that is free to decode would


class _Recording:
    """Frames that are all due at once; counts those that were decoded, and fails at number `broken`."""

    def __init__(self, count: int, broken: int = -1) -> None:
        self._count, self._broken = count, broken
        self.decoded = 0
        self.changed = threading.Condition()

    def frames(self) -> Iterator[Frame]:
        for index in range(self._count):
            if index == self._broken:
                raise ValueError("cannot be read on")
            with self.changed:
                self.decoded += 1
                self.changed.notify_all()
            yield Frame(0, index, np.zeros((2, 2), np.uint8), None, None, ImuBatch.empty())

    def reaches(self, decoded: int, within_s: float = _PATIENCE_S) -> bool:
        with self.changed:
            return self.changed.wait_for(lambda: self.decoded >= decoded, within_s)


def test_decoding_ahead_is_bounded() -> None:
    recording = _Recording(2 * READ_AHEAD)
    played = RecordedArrivals(recording.frames, LateFrameDropper(0.0)).iter_frames()
    next(played)
    most = READ_AHEAD + 2  # one with the tracker, one that waits for room
    assert recording.reaches(most)
    assert not recording.reaches(most + 1, _WHILE_S)


def test_every_frame_comes_in_order_and_the_end_ends_it() -> None:
    count = 3 * READ_AHEAD
    played = RecordedArrivals(_Recording(count).frames, LateFrameDropper(0.0)).iter_frames()
    assert [one.frame.index for one in played] == list(range(count))


def test_a_read_error_is_raised_after_the_frames_before_it() -> None:
    played = RecordedArrivals(_Recording(50, broken=40).frames, LateFrameDropper(0.0)).iter_frames()
    assert [next(played).frame.index for _ in range(40)] == list(range(40))
    with pytest.raises(ValueError, match="cannot be read on"):
        next(played)


def test_stop_ends_a_reader_that_waits_for_room() -> None:
    recording = _Recording(2 * READ_AHEAD)
    arrivals = RecordedArrivals(recording.frames, LateFrameDropper(0.0))
    played = arrivals.iter_frames()
    next(played)
    assert recording.reaches(READ_AHEAD)
    arrivals.stop()
    assert list(played) == []
    assert not [t for t in threading.enumerate() if t.name == "reader"]


class _Camera:
    """A live camera by what its arrivals ask of it."""

    image_ns, trouble, images_dropped = 7, "", 61

    def arrived_ns(self, stamp_ns: int) -> int:
        return stamp_ns


def test_dropped_images_are_reported_from_the_first_frame_on() -> None:
    camera: Any = _Camera()
    seen = LiveArrivals(_Recording(3).frames, camera)
    assert seen.tick() == AgentTick(7, "")
    frames = seen.iter_frames()
    next(frames)
    assert seen.tick().sensor_trouble == ""
    camera.images_dropped += 1
    assert seen.tick().sensor_trouble == "too slow for the camera: images are dropped"


# ---------------------------------------------------------------- frames that come late


MS = 1_000_000
IMAGE = np.zeros((4, 4), np.uint8)


def frame_with_imu(k: int) -> Frame:
    stamps = np.array([10 * k, 10 * k + 5], np.int64) * MS
    return Frame(10 * k * MS, k, IMAGE, imu=ImuBatch(stamps, np.full((2, 3), k), np.full((2, 3), -k)))


def test_a_frame_is_late_if_a_later_one_waits() -> None:
    late = LateFrameDropper(20.0)
    late.judge(frame_with_imu(0), 0, has_next=True)
    judged = [late.judge(frame_with_imu(k), ms * MS, has_next=True)[1] for k, ms in enumerate((19, 21, 21))]
    assert judged == [False, True, True] and late.dropped == 2


def test_each_frame_has_all_imu_samples_since_the_last_that_was_tracked() -> None:
    late = LateFrameDropper(20.0)
    late.judge(frame_with_imu(0), 0, has_next=True)
    late.judge(frame_with_imu(1), 30 * MS, has_next=True)
    second, is_late = late.judge(frame_with_imu(2), 30 * MS, has_next=True)
    assert is_late and second.imu.stamps_ns.tolist() == [10 * MS, 15 * MS, 20 * MS, 25 * MS]
    taken, is_late = late.judge(frame_with_imu(3), 5 * MS, has_next=True)
    assert not is_late and taken.index == 3
    assert taken.imu.stamps_ns.tolist() == [10 * MS, 15 * MS, 20 * MS, 25 * MS, 30 * MS, 35 * MS]
    assert taken.imu.gyro[:, 0].tolist() == [1, 1, 2, 2, 3, 3]
    assert taken.imu.accel[:, 0].tolist() == [-1, -1, -2, -2, -3, -3]
    following, _ = late.judge(frame_with_imu(4), 0, has_next=True)
    assert following.imu.stamps_ns.tolist() == [40 * MS, 45 * MS]


@pytest.mark.parametrize(("late_ms", "another"), [(0.0, True), (20.0, False)])
def test_no_frame_is_late_without_a_limit_or_a_later_frame(late_ms: float, another: bool) -> None:
    late = LateFrameDropper(late_ms)
    frame = frame_with_imu(1)
    assert late.judge(frame, 10**12, another) == (frame, False)
    assert late.dropped == 0


def test_a_machine_that_is_always_late_still_tracks_twice_a_second() -> None:
    """A recording whose frames wait: each would be predicted from the last one that was tracked."""
    late = LateFrameDropper(20.0)
    judged = [late.judge(frame_with_imu(k), 10**12, has_next=True) for k in range(500)]  # 5 s
    tracked = [frame.index for frame, is_late in judged if not is_late]
    assert len(tracked) == 10 and max(np.diff(tracked)) == 51
    assert max(len(frame.imu) for frame, _ in judged) == 2 * 51


def test_a_headset_with_an_imu_stays_fresh_by_default() -> None:
    headset, robot = hello_of("ann", 1), hello_of("rob", 2, AgentKind.ROBOT)
    assert late_limit_ms(None, headset) == 100.0
    assert late_limit_ms(None, replace(headset, rig=replace(headset.rig, imu=None))) == 0.0
    assert late_limit_ms(None, replace(headset, streams_frames=True)) == 0.0
    assert late_limit_ms(None, robot) == 400.0  # a bridge holds poses of 0.5 s for lost
    assert late_limit_ms(0.0, robot) == late_limit_ms(0.0, headset) == 0.0
    assert late_limit_ms(50.0, robot) == 50.0


# ---------------------------------------------------------------- poses that come late


def test_poses_in_time_are_not_reported() -> None:
    said: list[str] = []
    lateness = LatenessMonitor(said.append, "this machine", 50.0)
    for _ in range(300):
        lateness.record(45.0)
    assert (said, lateness.report()) == ([], {"late_frames": 0, "max_late_s": 0.045, "behind_frames": 0})


def test_who_cannot_keep_up_says_so_once_a_minute() -> None:
    """Headset poses were 3.4 s late, and nothing warned."""
    said: list[str] = []
    lateness = LatenessMonitor(said.append, "this machine", 20.0)
    for k in range(150):
        lateness.record(25.0 if k % 2 else 6.0)  # half of them: not most
    assert said == [] and lateness.report()["behind_frames"] == 0
    for _ in range(2000):
        lateness.record(25.0)
    line = "cannot keep up: 51 of the last 100 poses came more than 20 ms after their images; use smaller "
    assert said[0].startswith(line) and len(said) == 3
    assert lateness.report()["behind_frames"] == 2000


def test_late_poses_are_counted_and_reported_whenever_lateness_doubles() -> None:
    said: list[str] = []
    lateness = LatenessMonitor(said.append, "this machine", 1e6)
    for k in range(100):
        lateness.record(100.0 * k)  # to 9.9 s
    assert [line.split(":")[0] for line in said] == [f"poses are {s:.1f} s late" for s in (1, 2, 4, 8)]
    assert "this machine is too slow for this source; use smaller images" in said[0]
    assert lateness.report() == {"late_frames": 94, "max_late_s": 9.9, "behind_frames": 0}
