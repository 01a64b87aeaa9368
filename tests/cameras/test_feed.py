"""A camera's feed on a simulated camera: its notices and reconnections."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

import pytest

from share.cameras.feed import CameraFeed
from share.cameras.sample_queue import SampleQueue
from share.errors import NotAttachedError, ShareError, UsageError
from share.geometry.camera import Rig
from share.sensors.profile import load_profile
from share.sensors.sample_processor import DeviceSample
from share.sensors.watchdog import Health, Watchdog

RATES = {"cam0": 30.0, "accel": 250.0, "gyro": 400.0}


@dataclass
class Fake:
    """A simulated camera."""

    rig: Rig = field(default_factory=load_profile("d435i").rig)
    serial: str = "0123"
    rates_hz: dict[str, float] = field(default_factory=lambda: dict(RATES))
    sink: Callable[[DeviceSample], None] = print

    def start(self, sink: Callable[[DeviceSample], None]) -> None:
        self.sink = sink

    def stop(self) -> None:
        pass

    def reset(self) -> None:
        pass


def quick(now_ns: int, streams: Collection[str]) -> Watchdog:
    return Watchdog(now_ns, streams, silent_ms=100, warm_up_ms=100, retry_ms=10, reset_ms=10)


def wait(until: Callable[[], bool]) -> None:
    end = time.monotonic() + 5
    while not until():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_each_reason_why_a_camera_cannot_be_reopened_is_reported_once() -> None:
    answers: list[Fake | ShareError] = [
        Fake(),
        NotAttachedError("no RealSense camera is attached"),
        ShareError("cannot be opened: busy"),
        ShareError("cannot be opened: busy"),
        NotAttachedError("no RealSense camera is attached"),
        UsageError("is on USB 2.1, too slow"),
        Fake(),
    ]
    said: list[str] = []

    def connect(serial: str | None, epoch: int) -> Fake:
        answer = answers.pop(0) if answers else Fake()
        if isinstance(answer, ShareError):
            raise answer
        return answer

    first = answers[0]
    assert isinstance(first, Fake)
    feed = CameraFeed(connect, None, RATES, said.append, SampleQueue(), quick)
    feed.open()
    first.sink(DeviceSample("cam0", 10**9, None, time.monotonic_ns()))
    reader = threading.Thread(target=lambda: list(feed.measurements()), daemon=True)
    reader.start()
    wait(lambda: len(said) >= 4)
    feed.stop()
    reader.join(5)
    assert said[:4] == [
        "cam0, accel, gyro: no more samples; waiting for camera 0123 to come back",
        "cannot be opened: busy",
        "is on USB 2.1, too slow",
        "camera 0123 is connected again; a new segment begins",
    ]


@dataclass
class Playing(Fake):
    """A camera that delivers `streams` from a thread of its own until it is stopped."""

    streams: tuple[str, ...] = ()

    def start(self, sink: Callable[[DeviceSample], None]) -> None:
        self.sink, self._ended = sink, threading.Event()
        threading.Thread(target=self._play, daemon=True).start()

    def _play(self) -> None:
        while not self._ended.wait(0.005):
            for stream in self.streams:
                now = time.monotonic_ns()
                self.sink(DeviceSample(stream, now, (0, 0, 0), now))

    def stop(self) -> None:
        self._ended.set()


def test_a_needed_stream_that_never_comes_ends_the_feed_after_one_reset() -> None:
    said: list[str] = []
    feed = CameraFeed(
        lambda serial, epoch: Playing(streams=("accel", "gyro")),
        None,
        RATES,
        said.append,
        SampleQueue(),
        quick,
    )
    feed.open()
    with pytest.raises(
        ShareError, match="camera 0123: cam0: no sample, not even after a hardware reset; unplug"
    ):
        list(feed.measurements())
    assert said == [
        "cam0: no samples; resetting the camera once",
        "camera 0123 is connected again; a new segment begins",
        "cam0: no more samples; waiting for camera 0123 to come back",
        "camera 0123 is connected again; a new segment begins",
    ]
    assert feed.has_failed


def test_depth_beside_stereo_is_optional() -> None:
    said: list[str] = []
    rates = RATES | {"cam1": 30.0, "depth": 30.0}
    camera = Playing(streams=("cam0", "cam1", "accel", "gyro"))
    feed = CameraFeed(lambda serial, epoch: camera, None, rates, said.append, SampleQueue(), quick)
    feed.open()
    reader = threading.Thread(target=lambda: list(feed.measurements()), daemon=True)
    reader.start()
    wait(lambda: feed.health is Health.DEGRADED)
    assert said[-1] == "depth: still no samples; DEGRADED: continuing without"
    assert str(feed.status()).startswith("DEGRADED  ")
    camera.streams = (*camera.streams, "depth")
    wait(lambda: feed.health is Health.OK)
    assert said[-1] == "depth: samples come again"
    feed.stop()
    reader.join(5)
    assert (feed.report()["resets"], feed.has_failed) == (1, False)


def test_gaps_are_counted_by_the_cameras_own_rates() -> None:
    slow = Fake(rates_hz=RATES | {"accel": 100.0})
    feed = CameraFeed(lambda serial, epoch: slow, None, RATES, print, SampleQueue())
    feed.open()
    for at_ms in range(0, 1000, 10):
        for stream in ("accel", "gyro"):
            slow.sink(DeviceSample(stream, at_ms * 10**6, (0, 0, 0), at_ms * 10**6))
    feed.stop()
    joined = list(feed.measurements())
    assert len(joined) == 100
    assert (feed.processor.streams["accel"].gaps, feed.processor.streams["gyro"].gaps) == (0, 99)
