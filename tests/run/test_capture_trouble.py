"""Faults in the field while a simulated camera is recorded through the real SDK."""

from __future__ import annotations

import errno
import os
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.capture_bench import PICTURE, WANTED, Bench, Fake, quick

from share.cameras.realsense.streams import StreamRequest
from share.config import Config
from share.lab.calibrate.imu_table import read_imu
from share.recordings.mcap.recorder import recover_recording
from share.runtime.pipeline import read_frames
from share.runtime.source import open_source
from share.sensors.sequencer import SequencerCounters
from share.sensors.watchdog import Health

rs: Any = pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed", exc_type=ImportError)

CHILD = Path(__file__).with_name("capture_child.py")
MOST_US = 60_000_000  # of the camera's time, for what is waited for
ENV = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, CHILD.parents[1:3]))}  # tests, and the checkout


@pytest.mark.long
def test_a_clock_that_restarts_starts_a_new_segment(tmp_path: Path) -> None:
    with Bench(tmp_path / "a.mcap") as bench:
        bench.feed(500_000_000, 20)
        bench.feed(0, 30)
    stamps = open_source(str(tmp_path / "a.mcap")).stamps()["cam0"]
    steps = np.diff(stamps) * 1e-9
    assert (bench.report["restarts"], bench.report["segments"], bench.report["reconnections"]) == (1, 2, 0)
    assert 40 <= len(stamps) <= 43  # 0.25 s are the price of being sure
    assert steps.min() > 0
    assert steps.max() < 1.0  # as long as it was by the host's clock
    assert bench.said == ["the camera's clock restarted; a new segment begins"]


@pytest.mark.long
def test_images_by_the_hosts_clock_do_not_cost_the_imu(tmp_path: Path) -> None:
    with Bench(tmp_path / "a.mcap") as bench:
        bench.feed(1_000_000, 60, host_us=1_760_000_000_000_000)
    source = open_source(str(tmp_path / "a.mcap"))
    stamps = source.stamps()
    assert len(stamps["imu"]) == bench.report["imu"] > 0.95 * 60 * 13
    pairs = np.intersect1d(stamps["cam0"], stamps["cam1"])
    assert len(pairs) > 55
    longer = max(len(stamps["cam0"]), len(stamps["cam1"]))
    assert longer <= len(pairs) + 1  # one eye may begin an image earlier
    assert 0.8 * 10**9 < stamps["cam0"][0] < 3 * 10**9
    assert bench.said == [
        "cam0, cam1 carry the host's clock, accel, gyro the camera's: "
        "kernel patch missing, see docs/do/record.md"
    ]


def test_an_interleaved_emitter_without_metadata_is_reported(tmp_path: Path) -> None:
    device = replace(WANTED.profile.device, emitter="interleaved")
    with Bench(tmp_path / "a.mcap", wanted=StreamRequest(replace(WANTED.profile, device=device))) as bench:
        bench.feed(1_000_000, 10)
    assert bench.report["streams"]["cam0"]["samples"] == 10
    assert len(bench.said) == 1
    assert "which of them have dots, so all are kept" in bench.said[0]


def test_without_images_the_imu_alone_is_recorded(tmp_path: Path) -> None:
    with Bench(tmp_path / "a.mcap", wanted=replace(WANTED, images=False)) as bench:
        for k in range(400):
            bench.camera.force(1_000_000 + 2500 * k, 0.1, 0.2, 9.8)
            bench.camera.turn(1_000_000 + 2500 * k, k, 0.0, 0.0)
    imu = read_imu(str(tmp_path / "a.mcap")).imu
    assert bench.report["streams"].keys() == {"accel", "gyro"}
    np.testing.assert_array_equal(imu.stamps_ns, 10**9 + 2_500_000 * np.arange(400))
    np.testing.assert_array_equal(imu.gyro[:, 0], np.arange(400.0))


@pytest.mark.long
def test_of_an_interleaved_emitter_the_images_without_dots_are_recorded(tmp_path: Path) -> None:
    device = replace(WANTED.profile.device, emitter="interleaved")
    wanted = StreamRequest(replace(WANTED.profile, device=device))
    dots = np.full_like(PICTURE, 255)
    with Bench(tmp_path / "a.mcap", wanted=wanted) as bench:
        for k in range(20):
            bench.camera.stereo.set_metadata(rs.frame_metadata_value.frame_laser_power_mode, k % 2)
            for eye in (0, 1):
                bench.camera.image(eye, 1_000_000 + 33_333 * k, dots if k % 2 else PICTURE)
            time.sleep(0.01)
    source = open_source(str(tmp_path / "a.mcap"))
    images = [m.payload.load() for m in source.measurements() if m.stream != "imu"]
    assert len(images) == 20
    assert all(np.array_equal(image, PICTURE) for image in images)
    reported = bench.report["streams"]["cam0"]
    assert (reported["gaps"], reported["missing"]) == (0, 0)


@pytest.mark.long
@pytest.mark.parametrize(("missing", "eyes"), [("depth", (0, 1)), ("cam1", (0,))])
def test_missing_depth_costs_one_reset(tmp_path: Path, missing: str, eyes: tuple[int, ...]) -> None:
    now, wanted = 1_000_000, replace(WANTED, depth=missing == "depth")
    with Bench(tmp_path / "a.mcap", quick, wanted) as bench:
        while bench.source.health is not Health.DEGRADED:
            now = bench.feed(now, 5, eyes=eyes)
            assert now < MOST_US
        bench.feed(now, 20, eyes=eyes)
        bench.run.stop()
    assert Fake.resets == 1
    assert bench.said[-1] == f"{missing}: still no samples; DEGRADED: continuing without"
    assert bench.report["health"] == "DEGRADED"
    source, counters = open_source(str(tmp_path / "a.mcap")), SequencerCounters()
    assert source.notes == (f"has no images of {missing}: continuing without",)
    assert source.rig.kind == ("stereo+imu" if missing == "depth" else "mono+imu")
    frames = list(read_frames(source, Config(), counters))
    assert len(frames) >= bench.report["streams"]["cam0"]["samples"] - 2  # a pair cut by the reset


@pytest.mark.long
def test_missing_images_end_the_recording_after_one_reset(tmp_path: Path) -> None:
    now = 1_000_000
    with Bench(tmp_path / "a.mcap", quick) as bench:
        while bench.thread.is_alive():
            now = bench.feed(now, 5, eyes=())
            assert now < MOST_US
    assert bench.error == (
        "camera 0123: cam0, cam1: no sample, not even after a hardware reset; unplug it and plug it in "
        "again, if need be with another cable or port; nothing was recorded"
    )
    assert (Fake.resets, bench.connected) == (1, 3)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_a_full_disk_ends_the_recording_and_keeps_what_was_written(tmp_path: Path) -> None:
    most = 15_000_000  # bytes; the kernel refuses more, as a full disk does
    child = subprocess.run(
        [sys.executable, str(CHILD), str(tmp_path / "a.mcap")],
        env=ENV,
        text=True,
        capture_output=True,
        timeout=60,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most, most)),
    )
    reason = os.strerror(errno.EFBIG)
    assert child.returncode == 1
    out = tmp_path / "a.mcap"
    fix = f"`share dataset recover {out}.part --out {out}` saves its contents"
    assert child.stderr.splitlines() == [
        f"share: {out}.part: is not closed; {fix}",
        f"share: {out}: cannot be written: {reason}",
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap.part"]
    recover_recording(tmp_path / "a.mcap.part", tmp_path / "b.mcap")
    assert len(open_source(str(tmp_path / "b.mcap")).stamps()["cam0"]) > 15
