"""A rig written under Kalibr's names, as `share.io.calibration` reads it."""

from __future__ import annotations

from typing import Any

from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.io.calibration import CAMCHAIN, IMU_CHAIN, SERIAL, TIMESHIFT, Calibration


def to_kalibr(rig: Rig, said: Calibration | None = None, serial: str | None = None) -> dict[str, Any]:
    """cam0, cam1, depth (ours) and imu0 of the rig, as plain data for a YAML file.

    said: what the rig was known by before. Of that is kept what no Rig holds: topics, depth_scale and, for a
    rig without IMU, how cam0 sits on one and how late their clock is. serial: of the device, in each section:
    Kalibr takes every key at the top for a camera. Raises ConfigError.
    """
    said = said or Calibration(rig, "")
    T_imu_cam0, shift_s = (
        (said.T_imu_cam0, said.timeshift_s) if rig.imu is None else (rig.T_body_cam0, rig.timeshift_s)
    )
    shift = {TIMESHIFT: shift_s} if shift_s else {}  # 0 is what its absence means
    out = {"cam0": _camera(rig.cam0) | shift}
    if T_imu_cam0 is not None:
        out["cam0"]["T_cam_imu"] = se3.inverse(T_imu_cam0).tolist()
    if rig.imu is not None:
        out["imu0"] = _imu(rig.imu)
    if rig.cam1 is not None and rig.T_cam1_cam0 is not None:
        out["cam1"] = _camera(rig.cam1) | shift | {"T_cn_cnm1": rig.T_cam1_cam0.tolist()}
    if rig.depth is not None and rig.T_depth_cam0 is not None:
        T = rig.T_depth_cam0.tolist()
        out["depth"] = _camera(rig.depth) | {"T_depth_cam0": T, "depth_scale": said.depth_scale}
    for stream, topic in said.topics.items():
        name = "imu0" if stream == "imu" else stream
        if name in out:
            out[name]["rostopic"] = topic
    return {name: section | ({SERIAL: serial} if serial else {}) for name, section in out.items()}


def kalibr_texts(rig: Rig, remark: str, serial: str | None = None) -> dict[str, str]:
    """Both of Kalibr's chains, by the names of their files; one where the rig has no IMU. remark: a line;
    serial: of the device."""
    import yaml

    data = to_kalibr(rig, serial=serial)
    parts = {CAMCHAIN: {k: v for k, v in data.items() if k != "imu0"}}
    if "imu0" in data:
        parts[IMU_CHAIN] = {"imu0": data["imu0"]}
    return {
        name: f"# {remark}\n" + yaml.safe_dump(part, sort_keys=False, default_flow_style=None)
        for name, part in parts.items()
    }


def _camera(camera: Camera) -> dict[str, Any]:
    distortion = (
        {"distortion_model": camera.model, "distortion_coeffs": list(camera.distortion)}
        if camera.distortion
        else {"distortion_model": "none"}
    )
    return {
        "camera_model": "pinhole",
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        **distortion,
        "resolution": [camera.width, camera.height],
    }


def _imu(imu: ImuNoise) -> dict[str, Any]:
    return {
        "gyroscope_noise_density": imu.gyro_density,
        "gyroscope_random_walk": imu.gyro_walk,
        "accelerometer_noise_density": imu.accel_density,
        "accelerometer_random_walk": imu.accel_walk,
        "update_rate": imu.rate_hz,
    }
