"""Calibration files that others read: OpenCV's FileStorage, as OpenVINS uses it, and Kalibr's own fields."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.recordings.calibration import (
    CAMCHAIN,
    IMU_CHAIN,
    asl_camera_text,
    asl_imu_text,
    kalibr_texts,
    read_calibration,
)

SHIPPED = Path(__file__).resolve().parents[2] / "calib" / "d435i"
NOISE = ImuNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3, 200.0)
LENSES: dict[str, dict[str, Any]] = {
    "none": {},
    "radtan": {"distortion": (-0.28, 0.07, 2e-4, 1.76e-05)},
    "equidistant": {"distortion": (0.003, 1e-5, -2e-5, 1e-6), "model": "equidistant"},
}


def rig(lens: str = "radtan") -> Rig:
    camera = Camera(640, 480, 460.123456789, 461.0, 320.0, 240.0, **LENSES[lens])
    T_body_cam0 = se3.exp(np.array([0.1, -0.2, 0.3, 0.01, 0.02, 0.03]))
    T_cam1_cam0 = se3.exp(np.array([0.001, 0.002, 0.003, -0.05, 0.0, 0.0]))
    return Rig(camera, T_body_cam0, camera, T_cam1_cam0, imu=NOISE, timeshift_s=1.25e-3)


@pytest.fixture(params=["none", "radtan", "equidistant", "shipped"])
def folder(request, tmp_path) -> Path:
    if request.param == "shipped":
        return SHIPPED
    for name, text in kalibr_texts(rig(request.param), "a remark: with a colon", "0123456").items():
        (tmp_path / name).write_text(text)
    return tmp_path


def plain(node: Any) -> Any:
    """A FileStorage's node as plain data."""
    if node.isMap():
        return {key: plain(node.getNode(key)) for key in node.keys()}  # noqa: SIM118
    if node.isSeq():
        return [plain(node.at(i)) for i in range(node.size())]
    return node.string() if node.isString() else node.real()


def file_storage(path: Path) -> dict[str, Any]:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.isOpened()
    return {key: plain(storage.getNode(key)) for key in storage.root().keys()}  # noqa: SIM118


def test_file_storage_reads_what_yaml_reads(folder):
    for name in (CAMCHAIN, IMU_CHAIN):
        assert (folder / name).read_text().startswith("%YAML 1.0\n---\n")  # OpenCV 4 needs it
        assert file_storage(folder / name) == yaml.safe_load((folder / name).read_text())


def test_sections_have_kalibrs_fields(folder):
    """https://github.com/ethz-asl/kalibr/wiki/yaml-formats"""
    chain = yaml.safe_load((folder / CAMCHAIN).read_text())
    for section in chain.values():
        assert section["camera_model"] == "pinhole" and len(section["intrinsics"]) == 4
        count = {"none": 0, "radtan": 4, "equidistant": 4}[section["distortion_model"]]
        assert len(section["distortion_coeffs"]) == count and len(section["resolution"]) == 2
        assert section["rostopic"].startswith("/") and isinstance(section["timeshift_cam_imu"], float)
        assert np.shape(section["T_cam_imu"]) == (4, 4)
    T0, T1 = (np.array(chain[name]["T_cam_imu"]) for name in ("cam0", "cam1"))
    assert np.allclose(np.array(chain["cam1"]["T_cn_cnm1"]) @ T0, T1, atol=1e-9)
    imu = yaml.safe_load((folder / IMU_CHAIN).read_text())["imu0"]
    noise = {f"{s}_{k}" for s in ("accelerometer", "gyroscope") for k in ("noise_density", "random_walk")}
    assert imu.keys() >= noise | {"update_rate", "rostopic"}


@pytest.mark.parametrize("lens", LENSES)
def test_what_is_written_is_read_back(lens, tmp_path):
    for name, text in kalibr_texts(rig(lens), "remark").items():
        (tmp_path / name).write_text(text)
    read, written = read_calibration(tmp_path).rig, rig(lens)
    assert (read.cam0, read.cam1, read.imu) == (written.cam0, written.cam1, written.imu)
    assert read.timeshift_s == written.timeshift_s
    assert np.allclose(read.T_body_cam0, written.T_body_cam0, atol=1e-12)
    assert np.allclose(read.T_cam1_cam0, written.T_cam1_cam0, atol=1e-12)


@pytest.mark.parametrize("lens", LENSES)
def test_file_storage_reads_sensor_yaml(lens, tmp_path):
    """Of an EuRoC folder."""
    (tmp_path / "cam.yaml").write_text(asl_camera_text(rig(lens).cam0, np.eye(4), 20.0))
    (tmp_path / "imu.yaml").write_text(asl_imu_text(NOISE))
    camera, imu = file_storage(tmp_path / "cam.yaml"), file_storage(tmp_path / "imu.yaml")
    assert camera["distortion_coefficients"] == pytest.approx(list(rig(lens).cam0.distortion))
    assert camera["intrinsics"][0] == 460.123456789
    assert (camera["T_BS"]["rows"], len(camera["T_BS"]["data"])) == (4, 16)
    assert imu["rate_hz"] == 200.0


def test_without_an_imu_there_are_no_extrinsics_to_one():
    (text,) = kalibr_texts(rig().without_imu(), "remark").values()
    chain = yaml.safe_load(text)
    assert "T_cam_imu" not in chain["cam0"] and "timeshift_cam_imu" not in chain["cam1"]
    assert np.shape(chain["cam1"]["T_cn_cnm1"]) == (4, 4)
