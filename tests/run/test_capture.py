"""A camera of software, through the real SDK, to a file that can be read: whatever the camera does."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from software_camera import SoftwareCamera

from share.config import SequencerConfig
from share.core.watchdog import Watchdog
from share.errors import ShareError, UsageError
from share.io.feed import Feed
from share.io.handover import Handover
from share.io.mcap.recorder import Recorder
from share.io.profile import profile
from share.io.realsense.camera import RealSense
from share.io.realsense.streams import Wanted
from share.io.source import open_source
from share.run.capture import Capture

rs: Any = pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed", exc_type=ImportError)

WANTED = Wanted(profile("d435i"))
PICTURE = np.tile(np.arange(640, dtype=np.uint16) % 251, (480, 1)).astype(np.uint8)
WRAP_US = 2**32


class Fake:
    """RealSense on a camera of software, whose hardware reset is counted instead of done."""

    resets = 0

    def __init__(self, camera: SoftwareCamera, wanted: Wanted, epoch: int) -> None:
        self.device = RealSense(wanted, context=camera.context, epoch=epoch)
        self.rig, self.serial = self.device.rig, self.device.serial
        self.start, self.stop = self.device.start, self.device.stop

    def reset(self) -> None:
        Fake.resets += 1
        self.stop()


class Bench:
    """A capture in a thread of its own, and the camera that feeds it."""

    def __init__(
        self,
        out: Path,
        watchdog: Callable[[int, bool, bool], Watchdog] = Watchdog,
        wanted: Wanted = WANTED,
        most_images: int = 60,
    ) -> None:
        self.camera, self.said, self.there = SoftwareCamera(rs), list[str](), True
        self.wanted, self.connected = wanted, 0
        rates_hz, max_jump_s = wanted.rates_hz(), SequencerConfig().max_jump_s
        queue = Handover(most_images)
        feed = Feed(self.connect, None, rates_hz, max_jump_s, self.said.append, queue, watchdog)
        self.run = Capture(feed, out, 0.0, self.said.append)
        self.report: dict[str, Any] = {}
        self.thread = threading.Thread(target=self._go, daemon=True)

    def connect(self, serial: str | None, epoch: int) -> Fake:
        if not self.there:
            raise UsageError("no camera")
        fake = Fake(self.camera, self.wanted, epoch)
        self.connected += 1
        return fake

    def __enter__(self) -> Bench:
        Fake.resets = 0
        self.thread.start()
        self.wait(lambda: self.connected > 0)
        time.sleep(0.3)  # until the sensors deliver
        return self

    def __exit__(self, *error: object) -> None:
        time.sleep(0.3)  # until all has been read
        self.run.stop()
        self.thread.join(timeout=10)
        assert not self.thread.is_alive()

    def wait(self, until: Callable[[], bool], limit_s: float = 8.0) -> None:
        end = time.monotonic() + limit_s
        while not until():
            assert time.monotonic() < end, f"waited in vain; said: {self.said}"
            time.sleep(0.02)

    def feed(self, begin_us: int, frames: int, imu: bool = True, wrap: bool = False) -> int:
        """Frames at 30 Hz with IMU at 400 and 250 Hz; gives the stamp after them."""
        for k in range(frames):
            now = begin_us + k * 33_333
            at = [(now + i * 2500, True) for i in range(13)] + [(now + i * 4000, False) for i in range(8)]
            for stamp, turns in sorted(at) if imu else []:
                device_us = stamp % WRAP_US if wrap else stamp
                (self.camera.turn if turns else self.camera.force)(device_us, 0.1, 0.2, 9.8)
            for eye in (0, 1):
                self.camera.image(eye, now % WRAP_US if wrap else now, PICTURE)
            time.sleep(0.01)
        return begin_us + frames * 33_333

    def _go(self) -> None:
        self.report = self.run.go()


def test_what_the_camera_sees_is_in_the_recording(tmp_path: Path) -> None:
    with Bench(tmp_path / "a.mcap") as bench:
        bench.feed(1_000_000, 20)
    source = open_source(str(tmp_path / "a.mcap"))
    assert source.rig.kind == "stereo+imu"
    stamps = source.stamps()
    np.testing.assert_array_equal(stamps["cam0"], 10**9 + 33_333_000 * np.arange(20))
    np.testing.assert_array_equal(stamps["cam1"], stamps["cam0"])
    images = [m.payload.load() for m in source.measurements() if m.stream == "cam0"]
    assert all(np.array_equal(image, PICTURE) for image in images)
    assert bench.report["streams"]["cam0"]["samples"] == 20
    assert bench.report["streams"]["cam0"]["missing"] == 0
    assert len(stamps["imu"]) == bench.report["imu"] > 0.95 * 20 * 13
    assert bench.said == []


def test_the_wrap_of_the_cameras_clock_is_not_seen(tmp_path: Path) -> None:
    with Bench(tmp_path / "a.mcap") as bench:
        bench.feed(WRAP_US - 5 * 33_333, 10, wrap=True)
    stamps = open_source(str(tmp_path / "a.mcap")).stamps()
    np.testing.assert_array_equal(np.diff(stamps["cam0"]), np.full(9, 33_333_000))
    assert bench.report["wraps"] == 1
    assert bench.report["streams"]["gyro"]["backward"] == 0


def test_backward_and_missing_frames_are_counted_and_left_out(tmp_path: Path) -> None:
    with Bench(tmp_path / "a.mcap") as bench:
        after = bench.feed(1_000_000, 4)
        bench.camera.image(0, after - 100_000, PICTURE)
        bench.camera.image(0, after + 66_666, PICTURE, skip=2)
    told = bench.report["streams"]["cam0"]
    assert (told["samples"], told["backward"], told["missing"], told["gaps"]) == (5, 1, 3, 1)
    assert len(open_source(str(tmp_path / "a.mcap")).stamps()["cam0"]) == 5


def quick(now_ns: int, has_images: bool, has_imu: bool) -> Watchdog:
    return Watchdog(now_ns, has_images, has_imu, silent_ms=600, warm_up_ms=800, retry_ms=100)


def test_a_silent_imu_is_reset_once_then_images_go_on_alone(tmp_path: Path) -> None:
    with Bench(tmp_path / "a.mcap", quick) as bench:
        now, until = bench.feed(1_000_000, 10), time.monotonic() + 20
        while not any("VISION_ONLY" in text for text in bench.said) and time.monotonic() < until:
            now = bench.feed(now, 5, imu=False)
        bench.feed(now, 10, imu=False)
        bench.run.stop()  # at once: images that stop coming are another story
    assert Fake.resets == 1
    assert bench.report["health"] == "VISION_ONLY"
    assert bench.report["stretches"] == 2
    assert (np.diff(open_source(str(tmp_path / "a.mcap")).stamps()["cam0"]) > 0).all()


def test_a_camera_that_comes_back_with_a_new_clock_begins_a_new_stretch(tmp_path: Path) -> None:
    with Bench(tmp_path / "a.mcap", quick) as bench:
        bench.feed(500_000_000, 10)
        bench.there = False
        bench.wait(lambda: any("looks for camera" in text for text in bench.said))
        bench.there = True
        bench.wait(lambda: bench.connected == 2)
        time.sleep(0.2)
        bench.feed(0, 10)
    steps = np.diff(open_source(str(tmp_path / "a.mcap")).stamps()["cam0"]) * 1e-9
    assert len(steps) == 19
    assert (steps[steps < 0.1] > 0).all()
    assert 0.3 < steps.max() < 5  # as long as it was away, by the host's clock
    assert (bench.report["stretches"], bench.report["reconnections"]) == (2, 1)


def test_a_slow_disk_costs_images_that_are_counted_and_never_the_imu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = Recorder.write

    def slow(self: Recorder, measurement: Any, log_ns: int | None = None) -> None:
        time.sleep(0.03 if measurement.stream != "imu" else 0)
        write(self, measurement, log_ns)

    monkeypatch.setattr(Recorder, "write", slow)
    with Bench(tmp_path / "a.mcap", most_images=8) as bench:
        bench.feed(1_000_000, 30)
    told = bench.report["streams"]
    assert told["cam0"]["dropped"] > 5
    assert told["cam0"]["dropped"] == told["cam1"]["dropped"]
    assert told["cam0"]["samples"] + told["cam0"]["dropped"] == 30
    assert (told["gyro"]["dropped"], told["gyro"]["missing"]) == (0, 0)


def test_a_recording_is_not_overwritten_and_not_begun_on_a_full_disk(tmp_path: Path) -> None:
    there = tmp_path / "a.mcap"
    there.write_bytes(b"dear")
    for out, least, says in ((there, 0.0, "never overwritten"), (tmp_path / "b.mcap", 1e9, "must stay free")):
        run = Capture(Feed(_never, None, WANTED.rates_hz(), 10.0, print, Handover()), out, least, print)
        with pytest.raises(UsageError, match=says):
            run.go()
    assert there.read_bytes() == b"dear"
    assert list(tmp_path.iterdir()) == [there]


def _never(serial: str | None, epoch: int) -> Any:
    raise ShareError("the camera was opened")
