"""`share calibrate realsense` on librealsense, with a software camera."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.shell import Done
from helpers.software_camera import BASELINE, T_GYRO_IR, SoftwareCamera

from share.recordings.calibration import read_calibration

rs: Any = pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed", exc_type=ImportError)


@pytest.fixture(autouse=True)
def attached(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = SoftwareCamera(rs, depth=True)
    monkeypatch.setattr(rs, "context", lambda: camera.context)


def test_files_hold_the_factory_calibration(share: Callable[..., Done], tmp_path: Path) -> None:
    done = share("calibrate", "realsense", "0123", "--depth", "--out", tmp_path / "mine")
    assert done.code == 0, done.err
    assert "0123" in done.out
    found = read_calibration(tmp_path / "mine")
    rig = found.rig
    assert found.serials == ("0123",)
    assert rig.kind == "stereo+imu"
    assert rig.depth == rig.cam0
    assert (rig.cam0.fx, rig.cam0.fy, rig.cam0.cx, rig.cam0.cy) == (385.0, 386.0, 320.5, 239.5)
    assert rig.baseline == pytest.approx(BASELINE)
    np.testing.assert_allclose(rig.T_body_cam0[:3, 3], T_GYRO_IR, atol=1e-8)


def test_doctor_matches_the_serial_number(share: Callable[..., Done], tmp_path: Path) -> None:
    def line(*words: object) -> tuple[str, str]:
        reported = json.loads(share("doctor", "--json", *words).out)["findings"]
        return next((one["state"], one["what"]) for one in reported if one["name"] == "serial number")

    mine = tmp_path / "mine"
    share("calibrate", "realsense", "--out", mine)
    assert line("--calib", mine) == ("OK", "0123, as the calibration says")
    for chain in mine.iterdir():
        chain.write_text(chain.read_text().replace("'0123'", "'0456'"))
    assert line("--calib", mine) == ("WARN", "the calibration belongs to 0456; attached is 0123")


def test_existing_calibration_is_not_overwritten(share: Callable[..., Done], tmp_path: Path) -> None:
    dear = tmp_path / "kalibr_imu_chain.yaml"
    dear.write_text("dear")
    done = share("calibrate", "realsense", "--out", tmp_path)
    assert (done.code, done.out) == (2, "")
    assert "is not overwritten" in done.err
    assert [path.name for path in tmp_path.iterdir()] == [dear.name]
    assert dear.read_text() == "dear"


def test_missing_camera_is_reported_and_nothing_is_written(
    share: Callable[..., Done], tmp_path: Path
) -> None:
    done = share("calibrate", "realsense", "999", "--out", tmp_path / "mine")
    assert done.code == 2
    assert "0123 (Intel RealSense D435I)" in done.err
    assert list(tmp_path.iterdir()) == []


def test_camera_options_are_refused_for_a_recording(share: Callable[..., Done], tmp_path: Path) -> None:
    done = share("track", tmp_path, "--sensors", "rgbd")
    assert done.code == 2
    assert "--sensors works only with a live camera" in done.err
    done = share("track", "realsense", "--frames", "0:10")
    assert done.code == 2
    assert "--frames" in done.err


def test_camera_is_refused_where_a_recording_is_needed(share: Callable[..., Done]) -> None:
    done = share("dataset", "info", "realsense")
    assert done.code == 2
    assert "record a live camera with `share capture`" in done.err
