"""A room seen by a camera of software, through the real SDK: tracked live, and recorded and then tracked, it
comes to what tracking the original recording comes to."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.capture_bench import quick
from helpers.room_camera import BEGIN_US, HZ, RGBD, STEREO, RoomCamera

from share.cameras.live import MAX_WAITING_FRAMES, LiveSource
from share.cameras.sample_queue import NewestImageQueue, SampleQueue
from share.cli import camera_options
from share.config import Config
from share.geometry.camera import ImuBias
from share.odometry import initialisation
from share.odometry.track_result import TrackResult
from share.recordings.calibration import Calibration
from share.runtime.capture import Capture
from share.runtime.imu_bias_store import SavedBias, load_bias, save_bias
from share.runtime.offline_tracking import TrackingOutput, track
from share.runtime.source import Source, open_source

rs: Any = pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed", exc_type=ImportError)

SAME_M = 0.002  # calibration and IMU are of single precision there


def tracked(source: Source) -> TrackingOutput:
    return track(source, Config(), lambda result: None)


def assert_same(room: RoomCamera, run: TrackingOutput, original: TrackingOutput) -> None:
    """Poses at the same moments, and at the same places."""
    theirs = original.trajectory
    shift_ns = BEGIN_US * 1000 - room.first_ns
    np.testing.assert_allclose(run.trajectory.stamps_ns, theirs.stamps_ns + shift_ns, rtol=0, atol=1000)
    apart = np.linalg.norm(run.trajectory.T[:, :3, 3] - theirs.T[:, :3, 3], axis=1)
    assert apart.max() < SAME_M
    travelled = np.linalg.norm(np.diff(theirs.T[:, :3, 3], axis=0), axis=1).sum()
    assert travelled > 20 * SAME_M


@pytest.fixture(scope="module")
def room(plain_session: Path) -> RoomCamera:
    return RoomCamera(rs, open_source(str(plain_session / "ar1")))


@pytest.fixture(scope="module")
def original(room: RoomCamera) -> TrackingOutput:
    return tracked(room.source)


@pytest.mark.long
def test_a_recorded_camera_is_tracked_as_the_original(
    room: RoomCamera, original: TrackingOutput, tmp_path: Path
) -> None:
    feed, said = room.feed(STEREO, SampleQueue(), reported := []), reported
    room.begin(feed)
    run = Capture(feed, tmp_path / "a.mcap", 0.0, said.append)
    feed_stopped = feed.stop
    feed.stop = lambda: (feed_stopped(), run.stop())  # type: ignore[method-assign,assignment]
    report = run.run(30)
    assert (report["end_reason"], said) == ("stopped", [])
    assert_same(room, tracked(open_source(str(tmp_path / "a.mcap"))), original)


@pytest.mark.long
def test_a_live_camera_is_tracked_as_the_original(room: RoomCamera, original: TrackingOutput) -> None:
    said: list[str] = []
    source = LiveSource(room.feed(STEREO, NewestImageQueue(2 * MAX_WAITING_FRAMES), said), HZ)
    assert source.name == "realsense:0123"
    room.begin(source.feed)
    run = tracked(source)
    assert_same(room, run, original)
    assert run.report["camera"]["streams"]["cam0"] | {"seconds": 0} == {
        "samples": 45,
        "seconds": 0,
        "gaps": 0,
        "missing": 0,
        "backward": 0,
        "dropped": 0,
    }
    assert said == []


@pytest.mark.long
def test_a_live_camera_starts_with_the_bias_of_the_run_before(
    room: RoomCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, after = (ImuBias([0.0, x, 0.0], [0.0, 0.0, x], 1e-3, 2e-2) for x in (0.001, 0.002))
    save_bias("0123", SavedBias(time.time_ns() - 3600 * 10**9, before))
    begun: list[ImuBias] = []
    first_state = initialisation.state_from_imu
    monkeypatch.setattr(initialisation, "state_from_imu", lambda *a: begun.append(a[-1]) or first_state(*a))
    monkeypatch.setattr(initialisation, "estimated_bias", lambda *a: after)
    source = LiveSource(room.feed(STEREO, NewestImageQueue(2 * MAX_WAITING_FRAMES), []), HZ)
    room.begin(source.feed)
    run = tracked(source)
    assert (begun[0].gyro[1], begun[0].accel[2]) == (0.001, 0.001)
    assert 0.1 < begun[0].accel_sigma < 0.11
    assert run.report["imu_bias"]["learnt_at"] is not None
    learnt_at = run.report["imu_bias"]["learnt_at"]
    assert f"imu bias: from the run of {learnt_at}" in camera_options.camera_summary(run.report)
    assert run.report["tracked"] > 40
    kept = load_bias("0123")
    assert kept is not None
    assert kept.bias.gyro[1] == 0.002
    assert 0 <= time.time_ns() - kept.run_end_ns < 60 * 10**9
    begun.clear()
    assert "imu_bias" not in tracked(room.source).report  # a recording: as if nothing were known
    assert begun[0].accel_sigma == Config().inertial.accel_bias
    assert load_bias("0123").run_end_ns == kept.run_end_ns  # type: ignore[union-attr]


def test_a_calibration_of_another_camera_is_noted_and_used(room: RoomCamera) -> None:
    rig = replace(room.source.rig, depth=room.source.rig.cam0, T_depth_cam0=np.eye(4), timeshift_s=0.004)
    given = Calibration(rig, "mine", serials=("0456",))
    source = LiveSource(room.feed(STEREO, NewestImageQueue(2 * MAX_WAITING_FRAMES), []), HZ, given)
    source.close()
    assert (source.rig.timeshift_s, source.rig.depth) == (0.004, None)  # depth is not read
    (note,) = source.notes
    assert note.startswith("the calibration is of device 0456, this is 0123: ")


@pytest.mark.long
def test_a_slow_tracker_takes_the_newest_images_and_all_imu_samples(room: RoomCamera) -> None:
    source = LiveSource(room.feed(STEREO, NewestImageQueue(2 * MAX_WAITING_FRAMES), []), HZ)
    waited = []

    def slowly(result: TrackResult) -> None:
        stamp_ns = source.feed.processor.streams["cam0"].last_ns
        waited.append(time.monotonic_ns() - source.feed.arrived_ns(stamp_ns or 0))
        time.sleep(0.15)

    room.begin(source.feed, pause_s=0.03)
    run = track(source, Config(), slowly)
    streams = run.report["camera"]["streams"]
    assert streams["cam0"]["dropped"] == streams["cam1"]["dropped"] > 10
    assert run.report["frames"] + streams["cam0"]["dropped"] == 45
    assert (streams["gyro"]["dropped"], streams["accel"]["dropped"]) == (0, 0)
    assert run.report["sequencer"]["imu_samples"] > 1100
    assert run.report["tracked"] > 0.5 * run.report["frames"]
    assert np.median(waited) < 0.5e9


@pytest.mark.long
def test_depth_of_a_live_camera_is_in_metres_and_is_tracked(plain_session: Path) -> None:
    room = RoomCamera(rs, open_source(str(plain_session / "robot")))
    assert room.source.rig.depth is not None
    original = tracked(room.source)
    source = LiveSource(room.feed(RGBD, NewestImageQueue(2 * MAX_WAITING_FRAMES), []), HZ)
    assert (source.rig.cam1, source.rig.kind) == (None, "rgbd+imu")
    room.begin(source.feed)
    run = tracked(source)
    assert run.report["frames"] == 45
    assert_same(room, run, original)


@pytest.mark.long
def test_a_reconnected_camera_is_tracked_with_its_new_clock(plain_session: Path) -> None:
    room, said = RoomCamera(rs, open_source(str(plain_session / "ar1"))), list[str]()
    source = LiveSource(room.feed(STEREO, NewestImageQueue(200), said, quick), HZ)
    feed = source.feed

    def received(text: str) -> Callable[[], bool]:
        return lambda: any(text in line for line in said)

    def plugged() -> None:
        time.sleep(0.2)
        room.play(room.taken(feed))
        room.there = False
        wait_for(received("waiting for camera"))
        time.sleep(0.3)
        room.there = True
        wait_for(received("connected again"))
        room.play(lambda: time.sleep(1 / HZ), begin_us=0)
        wait_for(lambda: feed.processor.streams["cam0"].samples == 90)
        feed.stop()

    threading.Thread(target=plugged, daemon=True).start()
    run = tracked(source)
    camera, stamps_ns = run.report["camera"], run.trajectory.stamps_ns
    assert (camera["reconnections"], camera["segments"], camera["restarts"]) == (1, 2, 0)
    assert run.report["frames"] > 80
    assert run.report["sequencer"]["gaps"] == 1
    steps_s = np.diff(stamps_ns) * 1e-9
    assert steps_s.min() > 0.03
    assert 0.3 < steps_s.max() < 10  # as long as it was away, by the host's clock
    assert (stamps_ns[-1] - stamps_ns[np.argmax(steps_s) + 1]) * 1e-9 > 1.0  # it is tracked again


def wait_for(what: Callable[[], bool]) -> None:
    until = time.monotonic() + 20
    while not what():
        assert time.monotonic() < until
        time.sleep(0.02)
