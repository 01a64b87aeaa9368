"""Recordings that the maker's SDK writes of a camera of software: read without the SDK, and tracked."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from room_camera import RoomCamera
from shell import Done
from software_camera import BASELINE

from share.config import Config
from share.io.source import open_source
from share.run.track import track

rs: Any = pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed", exc_type=ImportError)


def recorded(session: Path, name: str, out: Path) -> RoomCamera:
    """What an agent of the session saw, recorded by the SDK in `out`."""
    room = RoomCamera(rs, open_source(str(session / name)))
    recorder = rs.recorder(str(out), room.camera.device)
    queues = []
    sensors = recorder.query_sensors()
    for sensor in sensors:
        queues.append(rs.frame_queue(5000, True))
        sensor.open(sensor.get_stream_profiles())
        sensor.start(queues[-1])
    room.play(lambda: time.sleep(0.02))
    time.sleep(0.5)
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    return room


@pytest.fixture(scope="module")
def stereo(plain_session: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[RoomCamera, Path]:
    out = tmp_path_factory.mktemp("sdk") / "walk.db3"
    return recorded(plain_session, "ar1", out), out


def test_it_is_tracked_as_what_the_camera_saw(stereo: tuple[RoomCamera, Path]) -> None:
    room, path = stereo
    source = open_source(str(path))
    assert (source.rig.kind, source.rig.baseline) == ("stereo+imu", pytest.approx(BASELINE))
    assert [len(stamps) for stamps in source.stamps().values()] == [45, 45, 1199]
    run, original = (track(one, Config(), lambda result: None) for one in (source, room.source))
    apart = run.trajectory.T[:, :3, 3] - original.trajectory.T[:, :3, 3]
    assert len(apart) == 45
    assert np.linalg.norm(apart, axis=1).max() < 0.002


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


def test_it_is_converted_and_told_of(
    stereo: tuple[RoomCamera, Path], share: Callable[..., Done], tmp_path: Path
) -> None:
    _, path = stereo
    told = share("dataset", "info", path)
    assert (told.code, "stereo+imu" in told.out, "profile d435i" in told.out) == (0, True, True)
    assert share("dataset", "convert", path, "--frames", "5:15", "--out", tmp_path / "a.mcap").code == 0
    stamps = open_source(str(tmp_path / "a.mcap")).stamps()
    np.testing.assert_array_equal(stamps["cam0"], open_source(str(path)).stamps()["cam0"][5:15])


def test_a_file_that_is_none_is_said_in_a_line(share: Callable[..., Done], tmp_path: Path) -> None:
    (tmp_path / "a.db3").write_bytes(b"no database")
    sqlite3.connect(tmp_path / "b.db3").close()
    for name in ("a.db3", "b.db3"):
        done = share("dataset", "info", tmp_path / name)
        assert (done.code, done.out, done.err.count("\n")) == (1, "", 1)
        assert "no recording of the RealSense SDK" in done.err
