"""The noise of an IMU is stated by a file, by a recording, or unknown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from share.errors import UsageError
from share.geometry.camera import Camera, ImuNoise, Rig
from share.lab.calibrate.imu_table import stated_noise
from share.recordings.calibration import to_kalibr
from share.recordings.mcap.recorder import Recorder
from share.sensors.measurement import IMU, Measurement

NOISE = ImuNoise(2.4e-4, 1.5e-3, 1e-5, 1.5e-4, 200.0)
RIG = Rig(Camera(64, 48, 40.0, 40.0, 31.5, 23.5), np.eye(4), imu=NOISE)
SHEET = """gyroscope_noise_density: 2.4e-4
gyroscope_random_walk: 1.0e-5
accelerometer_noise_density: 1.5e-3
accelerometer_random_walk: 1.5e-4
rate_hz: 200
"""


def recorded(path: Path, rig: Rig) -> Path:
    """Record as `share capture --imu-only` does."""
    with Recorder(path, rig) as recorder:
        recorder.write(Measurement(IMU, 10**9, (0.0,) * 6))
    return path


def test_a_recording_of_the_imu_alone_states_its_noise(tmp_path: Path) -> None:
    assert stated_noise(str(recorded(tmp_path / "a.mcap", RIG)), None, "--calib") == NOISE
    silent = recorded(tmp_path / "b.mcap", replace(RIG, imu=None))
    with pytest.raises(UsageError, match=r"b\.mcap: does not state the IMU's noise; give --calib DIR"):
        stated_noise(str(silent), None, "--calib")


@pytest.mark.parametrize("where", ["imu0", "mav0/imu0", "."])
def test_a_folder_states_the_noise_or_is_refused(tmp_path: Path, where: str) -> None:
    (tmp_path / where).mkdir(parents=True, exist_ok=True)
    (tmp_path / where / "data.csv").write_text("1000,0,0,0,0,0,9.8\n")
    with pytest.raises(UsageError, match="does not state the IMU's noise; give --imu DIR"):
        stated_noise(str(tmp_path), None, "--imu")
    (tmp_path / where / "sensor.yaml").write_text(SHEET)
    assert stated_noise(str(tmp_path), None, "--imu") == NOISE


def test_a_given_imu_chain_overrides_the_source(tmp_path: Path) -> None:
    chain = to_kalibr(replace(RIG, imu=replace(NOISE, rate_hz=100.0)))
    (tmp_path / "imu.yaml").write_text(yaml.safe_dump({"imu0": chain.pop("imu0")}))
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(chain))
    source = str(recorded(tmp_path / "a.mcap", RIG))
    assert stated_noise(source, str(tmp_path / "imu.yaml"), "--calib").rate_hz == 100
    with pytest.raises(UsageError, match=r"--calib .*camera\.yaml: has no imu0; give kalibr_imu_chain\.yaml"):
        stated_noise(source, str(tmp_path / "camera.yaml"), "--calib")


def test_an_absent_source_is_named(tmp_path: Path) -> None:
    for name in ("no.csv", "no.mcap", "no"):
        with pytest.raises(UsageError, match=f"{name}: no such file or folder"):
            stated_noise(str(tmp_path / name), None, "--calib")
