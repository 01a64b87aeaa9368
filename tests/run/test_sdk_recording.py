"""Recordings of a simulated camera by the maker's SDK: read without the SDK, and tracked."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.room_camera import RoomCamera
from helpers.shell import Done
from helpers.software_camera import BASELINE, SoftwareCamera

from share.cameras.realsense.camera import RealSenseCamera
from share.cameras.realsense.streams import StreamRequest
from share.config import Config
from share.geometry import se3
from share.lab.calibrate.imu_table import read_imu
from share.runtime.offline_tracking import track
from share.runtime.source import open_source
from share.sensors.profile import load_profile

rs: Any = pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed", exc_type=ImportError)


class Turned(SoftwareCamera):
    """Its right eye is turned about all axes."""

    def _shift(self, *metres: float) -> Any:
        reported = super()._shift(*metres)
        if metres[0] == -BASELINE:
            reported.rotation = se3.exp(np.array([0.1, 0.2, 0.3, 0, 0, 0]))[:3, :3].ravel(order="F").tolist()
        return reported


def recorded(session: Path, name: str, out: Path) -> RoomCamera:
    """What an agent of the session saw, recorded by the SDK in `out`."""
    room = RoomCamera(rs, open_source(str(session / name)))
    record(room.camera, out, lambda: room.play(lambda: time.sleep(0.02)))
    return room


def record(camera: SoftwareCamera, out: Path, play: Callable[[], object]) -> None:
    recorder = rs.recorder(str(out), camera.device)
    queues = []
    sensors = recorder.query_sensors()
    for sensor in sensors:
        queues.append(rs.frame_queue(5000, True))
        sensor.open(sensor.get_stream_profiles())
        sensor.start(queues[-1])
    play()
    time.sleep(0.5)
    for sensor in sensors:
        sensor.stop()
        sensor.close()


@pytest.fixture(scope="module")
def stereo(plain_session: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[RoomCamera, Path]:
    out = tmp_path_factory.mktemp("sdk") / "walk.db3"
    return recorded(plain_session, "ar1", out), out


@pytest.mark.long
def test_it_is_tracked_like_the_cameras_images(stereo: tuple[RoomCamera, Path]) -> None:
    room, path = stereo
    source = open_source(str(path))
    assert (source.rig.kind, source.rig.baseline) == ("stereo+imu", pytest.approx(BASELINE))
    assert [len(stamps) for stamps in source.stamps().values()] == [45, 45, 1199]
    run, original = (track(one, Config(), lambda result: None) for one in (source, room.source))
    apart = run.trajectory.T[:, :3, 3] - original.trajectory.T[:, :3, 3]
    assert len(apart) == 45
    assert np.linalg.norm(apart, axis=1).max() < 0.002


@pytest.mark.long
def test_images_are_the_same_to_the_last_bit_and_depth_is_in_metres(
    plain_session: Path, tmp_path: Path
) -> None:
    room = recorded(plain_session, "robot", tmp_path / "a.db3")
    theirs, ours = (
        {s: [m.payload.load() for m in one.measurements() if m.stream == s] for s in ("cam0", "depth")}
        for one in (room.source, open_source(str(tmp_path / "a.db3")))
    )
    assert len(ours["cam0"]) == len(ours["depth"]) == 45
    assert all(np.array_equal(a, b) for a, b in zip(ours["cam0"], theirs["cam0"], strict=True))
    for a, b in zip(ours["depth"], theirs["depth"], strict=True):
        np.testing.assert_allclose(np.nan_to_num(a), np.nan_to_num(b), atol=0.00026)


def test_its_extrinsics_are_those_of_the_sdk(tmp_path: Path) -> None:
    camera = Turned(rs)
    with RealSenseCamera(StreamRequest(load_profile("d435i")), context=camera.context) as device:
        theirs = device.rig

    def play() -> None:
        for eye in (0, 1):
            camera.image(eye, 10**6, np.zeros((480, 640), np.uint8))

    record(camera, tmp_path / "a.db3", play)
    ours = open_source(str(tmp_path / "a.db3")).rig
    assert theirs.T_cam1_cam0 is not None
    assert ours.T_cam1_cam0 is not None
    np.testing.assert_allclose(ours.T_cam1_cam0, theirs.T_cam1_cam0, atol=1e-6)
    assert (ours.cam0, ours.imu) == (theirs.cam0, None)


def test_it_is_converted_and_described(
    stereo: tuple[RoomCamera, Path], share: Callable[..., Done], tmp_path: Path
) -> None:
    _, path = stereo
    reported = share("dataset", "info", path)
    assert (reported.code, "stereo+imu" in reported.out, "profile d435i" in reported.out) == (0, True, True)
    assert "device 0123" in reported.out
    assert share("dataset", "convert", path, "--frames", "5:15", "--out", tmp_path / "a.mcap").code == 0
    converted = open_source(str(tmp_path / "a.mcap"))
    stamps = converted.stamps()
    assert converted.serial == "0123"
    np.testing.assert_array_equal(stamps["cam0"], open_source(str(path)).stamps()["cam0"][5:15])


def test_its_imu_is_calibrated_as_that_of_any_recording(
    stereo: tuple[RoomCamera, Path], share: Callable[..., Done], tmp_path: Path
) -> None:
    _, path = stereo
    share("dataset", "convert", path, "--out", tmp_path / "a.mcap")
    ours, converted = read_imu(str(path)), read_imu(str(tmp_path / "a.mcap"))
    assert (ours.name, ours.dropped, len(ours.imu)) == ("walk", 0, 1199)
    np.testing.assert_array_equal(ours.imu.stamps_ns, converted.imu.stamps_ns)
    np.testing.assert_array_equal(ours.imu.gyro, converted.imu.gyro)
    np.testing.assert_array_equal(ours.imu.accel, converted.imu.accel)


def test_without_an_accelerometer_there_is_no_imu_to_calibrate(
    share: Callable[..., Done], tmp_path: Path
) -> None:
    camera = SoftwareCamera(rs)
    record(camera, tmp_path / "a.db3", lambda: [camera.turn(10**6 + k * 2500, 0, 0, 0) for k in range(9)])
    done = share("calibrate", "imu", tmp_path / "a.db3", "--out", tmp_path / "out")
    assert (done.code, done.out, done.err.count("\n")) == (1, "", 1)
    assert "a.db3: has no" in done.err


def test_a_file_that_is_no_recording_is_refused(share: Callable[..., Done], tmp_path: Path) -> None:
    (tmp_path / "a.db3").write_bytes(b"no database")
    sqlite3.connect(tmp_path / "b.db3").close()
    for name in ("a.db3", "b.db3"):
        done = share("dataset", "info", tmp_path / name)
        assert (done.code, done.out, done.err.count("\n")) == (1, "", 1)
        assert "not a recording of the RealSense SDK" in done.err
