"""Uncertainty of cameras, read from the report beside their camchain."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.camera_imu_sim import CAM0, CAM1, T_CAM1_CAM0

from share.errors import DataError
from share.geometry.camera import Rig
from share.lab.calibrate.camera_initialisation import intrinsics, parameter_names
from share.lab.calibrate.camera_report import read_rig_uncertainty

RIG = Rig(CAM0, np.eye(4), CAM1, T_CAM1_CAM0)
COVARIANCE = np.diag(np.arange(1.0, 23)).tolist()


def report(**changed: object) -> str:
    cameras = [
        {"parameters": dict(zip(parameter_names(one), intrinsics(one).tolist(), strict=True))}
        for one in (CAM0, CAM1)
    ]
    whole = {
        "passed": True,
        "covariance": COVARIANCE,
        "cameras": cameras,
        "T_cam1_cam0": T_CAM1_CAM0.tolist(),
    }
    return json.dumps(whole | changed)


def test_the_report_of_these_cameras_gives_their_covariance(tmp_path: Path) -> None:
    (tmp_path / "camera-report.json").write_text(report())
    found = read_rig_uncertainty(tmp_path / "chain.yaml", RIG)
    assert found.covariance is not None and found.covariance.tolist() == COVARIANCE and found.passed
    assert found.source == str(tmp_path / "camera-report.json")


def test_a_failed_report_gives_the_covariance_and_the_failure(tmp_path: Path) -> None:
    (tmp_path / "camera-report.json").write_text(report(cameras=[]))  # of other cameras
    (tmp_path / "camera-report.failed.json").write_text(report(passed=False))
    found = read_rig_uncertainty(tmp_path / "chain.yaml", RIG)
    assert found.covariance is not None and not found.passed


@pytest.mark.parametrize("rig", [Rig(CAM0, np.eye(4)), replace(RIG, cam0=replace(CAM0, fx=385.1))])
def test_a_report_of_other_cameras_is_ignored(tmp_path: Path, rig: Rig) -> None:
    (tmp_path / "camera-report.json").write_text(report())
    found = read_rig_uncertainty(tmp_path / "chain.yaml", rig)
    assert found.covariance is None and "no camera-report.json of these cameras" in found.source


def test_no_report_or_an_old_one_gives_no_covariance(tmp_path: Path) -> None:
    assert read_rig_uncertainty(tmp_path / "chain.yaml", RIG).covariance is None
    old = json.loads(report())
    del old["covariance"]
    (tmp_path / "camera-report.json").write_text(json.dumps(old))
    assert read_rig_uncertainty(tmp_path / "chain.yaml", RIG).covariance is None


@pytest.mark.parametrize(
    "text", ["{", report(covariance=[[1.0]]), report(covariance="?"), report(covariance=[[None] * 22] * 22)]
)
def test_a_damaged_report_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "camera-report.json").write_text(text)
    with pytest.raises(DataError, match=r"camera-report\.json: is damaged"):
        read_rig_uncertainty(tmp_path / "chain.yaml", RIG)
