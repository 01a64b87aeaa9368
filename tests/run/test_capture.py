"""A simulated camera, through the real SDK, to a readable file, whatever the camera does."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.capture_bench import PICTURE, WANTED, WRAP_US, Bench, Fake, quick

from share.cameras.feed import CameraFeed
from share.cameras.sample_queue import SampleQueue
from share.errors import ShareError, UsageError
from share.lab.calibrate.imu_table import read_imu
from share.recordings.calibration import Calibration
from share.recordings.mcap.recorder import Recorder
from share.runtime.capture import Capture
from share.runtime.source import open_source
from share.sensors.measurement import Measurement
from share.sensors.profile import load_profile
from share.sensors.sample_processor import DeviceSample

rs: Any = pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed", exc_type=ImportError)


@pytest.mark.long
def test_the_recording_contains_the_cameras_images(tmp_path: Path) -> None:
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


def test_a_calibration_of_another_camera_is_recorded_and_reported(tmp_path: Path) -> None:
    own = load_profile("d435i").rig()
    given = Calibration(replace(own, timeshift_s=0.004), "mine", serials=("0456",))
    with Bench(tmp_path / "a.mcap", calibration=given) as bench:
        bench.feed(1_000_000, 5)
    source = open_source(str(tmp_path / "a.mcap"))
    assert (source.serial, source.rig.timeshift_s, source.rig.cam0) == ("0123", 0.004, own.cam0)
    (said,) = bench.said
    assert said.startswith("camera 0123: the calibration is of device 0456, this is 0123: ")


def test_a_calibration_of_other_images_ends_it_before_there_is_a_file(tmp_path: Path) -> None:
    given = Calibration(load_profile("d435i", "848x480").rig(), "mine")
    bench = Bench(tmp_path / "a.mcap", calibration=given)
    with pytest.raises(UsageError, match="mine: its cam0 is 848x480, the camera sends 640x480; add --mode"):
        bench.run.run(1)
    assert list(tmp_path.iterdir()) == []


def test_the_wrap_of_the_cameras_clock_is_removed(tmp_path: Path) -> None:
    with Bench(tmp_path / "a.mcap") as bench:
        bench.feed(WRAP_US - 5 * 33_333, 10, wrap=True)
    stamps = open_source(str(tmp_path / "a.mcap")).stamps()
    np.testing.assert_array_equal(np.diff(stamps["cam0"]), np.full(9, 33_333_000))
    assert bench.report["wraps"] == 1
    assert bench.report["streams"]["gyro"]["backward"] == 0


def test_backward_and_missing_frames_are_counted_and_skipped(tmp_path: Path) -> None:
    with Bench(tmp_path / "a.mcap") as bench:
        after = bench.feed(1_000_000, 4)
        bench.camera.image(0, after - 100_000, PICTURE)
        bench.camera.image(0, after + 66_666, PICTURE, skip=2)
    reported = bench.report["streams"]["cam0"]
    assert (reported["samples"], reported["backward"], reported["missing"], reported["gaps"]) == (5, 1, 3, 1)
    assert len(open_source(str(tmp_path / "a.mcap")).stamps()["cam0"]) == 5


@pytest.mark.long
def test_a_silent_imu_is_reset_once_then_images_go_on_alone(tmp_path: Path) -> None:
    with Bench(tmp_path / "a.mcap", quick) as bench:
        now, until = bench.feed(1_000_000, 10), time.monotonic() + 20
        while not any("VISION_ONLY" in text for text in bench.said) and time.monotonic() < until:
            now = bench.feed(now, 5, imu=False)
        bench.feed(now, 10, imu=False)
        bench.run.stop()  # at once: images that stop coming are another story
    assert Fake.resets == 1
    assert bench.report["health"] == "VISION_ONLY"
    assert bench.report["segments"] == 2
    assert (np.diff(open_source(str(tmp_path / "a.mcap")).stamps()["cam0"]) > 0).all()


@pytest.mark.long
def test_a_reconnected_camera_with_a_new_clock_starts_a_new_segment(tmp_path: Path) -> None:
    with Bench(tmp_path / "a.mcap", quick) as bench:
        bench.feed(500_000_000, 10)
        bench.there = False
        bench.wait(lambda: any("waiting for camera" in text for text in bench.said))
        bench.there = True
        bench.wait(lambda: bench.connected == 2)
        time.sleep(0.2)
        bench.feed(0, 10)
    steps = np.diff(open_source(str(tmp_path / "a.mcap")).stamps()["cam0"]) * 1e-9
    assert len(steps) == 19
    assert (steps[steps < 0.1] > 0).all()
    assert 0.3 < steps.max() < 5  # as long as it was away, by the host's clock
    assert (bench.report["segments"], bench.report["reconnections"]) == (2, 1)


@pytest.mark.long
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
    reported = bench.report["streams"]
    assert reported["cam0"]["dropped"] > 5
    assert reported["cam0"]["dropped"] == reported["cam1"]["dropped"]
    assert reported["cam0"]["samples"] + reported["cam0"]["dropped"] == 30
    assert (reported["gyro"]["dropped"], reported["gyro"]["missing"]) == (0, 0)


def test_a_recording_is_not_overwritten_and_not_begun_on_a_full_disk(tmp_path: Path) -> None:
    there = tmp_path / "a.mcap"
    there.write_bytes(b"dear")
    for out, least, says in ((there, 0.0, "never overwritten"), (tmp_path / "b.mcap", 1e9, "must stay free")):
        run = Capture(CameraFeed(_never, None, WANTED.rates_hz(), print, SampleQueue()), out, least, print)
        with pytest.raises(UsageError, match=says):
            run.run()
    assert there.read_bytes() == b"dear"
    assert list(tmp_path.iterdir()) == [there]


def test_a_partial_recording_is_not_overwritten(tmp_path: Path) -> None:
    part, out = tmp_path / "a.mcap.part", tmp_path / "a.mcap"
    part.write_bytes(b"dear")
    run = Capture(CameraFeed(_never, None, WANTED.rates_hz(), print, SampleQueue()), out, 0.0, print)
    with pytest.raises(
        UsageError, match=rf"a\.mcap\.part: belongs to .* recover {part} --out {out}`, or give"
    ):
        run.run()
    assert part.read_bytes() == b"dear"


def test_of_two_recordings_of_one_name_the_second_is_refused(tmp_path: Path) -> None:
    rig = WANTED.profile.rig()
    with Recorder(tmp_path / "a.mcap", rig, durable=True) as first:
        with pytest.raises(UsageError, match="or is still running"):
            Recorder(tmp_path / "a.mcap", rig, durable=True)
        first.write(Measurement("imu", 10**9, np.zeros(6)))
    assert len(read_imu(str(tmp_path / "a.mcap")).imu.stamps_ns) == 1


class Gyroscope:
    """A camera whose accelerometer says nothing."""

    rig, serial, rates_hz = WANTED.profile.rig(), "0123", {"accel": 250.0, "gyro": 400.0}

    def start(self, sink: Callable[[DeviceSample], None]) -> None:
        for k in range(100):
            sink(DeviceSample("gyro", k * 2_500_000, (0, 0, 0), k * 2_500_000))

    def stop(self) -> None:
        pass

    reset = stop


def test_an_imu_alone_without_an_accelerometer_is_no_recording(tmp_path: Path) -> None:
    feed = CameraFeed(lambda *_: Gyroscope(), None, Gyroscope.rates_hz, print, SampleQueue())
    with pytest.raises(
        ShareError, match=r"0123: samples came \(0 of accel, 100 of gyro\), but the IMU needs"
    ):
        Capture(feed, tmp_path / "a.mcap", 0.0, print).run(0.3)
    assert list(tmp_path.iterdir()) == []


def _never(serial: str | None, epoch: int) -> Any:
    raise ShareError("the camera was opened")
