"""Read and write calibration files: Kalibr's chains, EuRoC's sensor.yaml, camera.yaml of RGB-D folders.

The body is the IMU's frame, or cam0's if there is no IMU. Cameras are pinhole with radial-tangential,
equidistant (fisheye) or no distortion; other models are refused by name. docs/lookup/data.md specifies the
files.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import ConfigError
from share.files.yaml_file import Section, read_yaml
from share.geometry import se3
from share.geometry.camera import MAX_TIMESHIFT_S, Camera, ImuNoise, Rig
from share.geometry.lens import COEFFICIENT_COUNTS, EQUIDISTANT, RADTAN
from share.types import F64

CAMCHAIN = "kalibr_imucam_chain.yaml"
IMU_CHAIN = "kalibr_imu_chain.yaml"
_MODELS = dict.fromkeys(("radtan", "radial-tangential", "plumb_bob"), RADTAN)  # by name in files
_MODELS |= dict.fromkeys(("equidistant", "kannala_brandt", "fisheye"), EQUIDISTANT)
_NOISE_KEYS = {
    "gyro_density": "gyroscope_noise_density",
    "gyro_walk": "gyroscope_random_walk",
    "accel_density": "accelerometer_noise_density",
    "accel_walk": "accelerometer_random_walk",
}
DEFAULT_TOPICS = {  # of our MCAP recordings (`share.recordings.mcap.ros_messages.TOPICS`), by section
    "cam0": "/cam0/image_raw",
    "cam1": "/cam1/image_raw",
    "depth": "/depth/image_raw",
    "imu0": "/imu0",
}
TIMESHIFT = "timeshift_cam_imu"
SERIAL = "serial"
_MAX_TIMESHIFT_SPREAD_S = 1e-3  # between the timeshifts of synchronised cameras
_DEFAULT_DEPTH_SCALE = 1000.0  # units per metre: 16-bit depth in mm, as in ROS and RealSense


@dataclass(frozen=True, eq=False)
class Calibration:
    """A rig and what else its file states.

    where: the file. depth_scale: units per metre. topics: ROS topic by stream. camera_sections: of cam0 and
    cam1, as read. serials: distinct serial numbers of the devices that the file names.
    """

    rig: Rig
    where: str
    depth_scale: float = _DEFAULT_DEPTH_SCALE
    topics: dict[str, str] = field(default_factory=dict)
    camera_sections: tuple[Section, ...] = ()
    serials: tuple[str, ...] = ()

    @property
    def T_imu_cam0(self) -> F64 | None:
        """(4, 4) as the file states it, even without an IMU chain; None if absent. Raises ConfigError."""
        has_extrinsics = (
            self.camera_sections and {"T_cam_imu", "T_imu_cam"} & self.camera_sections[0].data.keys()
        )
        return kalibr_T_imu_cam(self.camera_sections[0]) if has_extrinsics else None

    @property
    def timeshift_s(self) -> float:
        """IMU time minus camera time, s, as the file states it. Raises ConfigError."""
        return _mean_timeshift_s(self.camera_sections)


def read_calibration(path: Path) -> Calibration:
    """Read a Kalibr camchain file, a folder with Kalibr's chains, or a camera.yaml. Raises ConfigError."""
    if path.is_dir():
        if not (path / CAMCHAIN).exists():
            raise ConfigError(f"{path}: has no {CAMCHAIN}; give a Kalibr camchain file or a folder with one")
        imu = path / IMU_CHAIN
        return read_kalibr(path / CAMCHAIN, imu if imu.exists() else None)
    top = read_yaml(path)
    return read_kalibr(path) if "cam0" in top else read_camera_yaml(path)


def read_kalibr(path: Path, imu_path: Path | None = None) -> Calibration:
    """Read Kalibr's camchain and IMU chain. Without the latter the rig has no IMU, and body = cam0."""
    return calibration_from_kalibr(read_yaml(path), read_yaml(imu_path).section("imu0") if imu_path else None)


def calibration_from_kalibr(chain: Section, imu: Section | None) -> Calibration:
    """Make a calibration of a camchain (cam0, cam1 and, our extension, depth) and an IMU chain's imu0."""
    cams = {name: chain.section(name) for name in ("cam0", "cam1", "depth") if name in chain}
    cam0 = chain.section("cam0")
    camera_sections = tuple(cams[name] for name in ("cam0", "cam1") if name in cams)
    rig = Rig(
        cam0=_read_camera(cam0),
        T_body_cam0=kalibr_T_imu_cam(cam0) if imu else np.eye(4),
        imu=imu_noise(imu, "update_rate") if imu else None,
        timeshift_s=_mean_timeshift_s(camera_sections) if imu else 0.0,
    )
    if "cam1" in cams:
        T_cam1_cam0 = _kalibr_T_cam1_cam0(cam0, cams["cam1"])
        with config_errors(cams["cam1"].where):
            rig = replace(rig, cam1=_read_camera(cams["cam1"]), T_cam1_cam0=T_cam1_cam0)
    scale = _DEFAULT_DEPTH_SCALE
    if "depth" in cams:
        depth = cams["depth"]
        rig = replace(rig, depth=_read_camera(depth), T_depth_cam0=depth.pose("T_depth_cam0"))
        scale = depth.number("depth_scale", _DEFAULT_DEPTH_SCALE, positive=True)
    named = cams | ({"imu": imu} if imu else {})
    topics = {name: section.text("rostopic", "") for name, section in named.items()}
    stated_topics = {k: v for k, v in topics.items() if v}
    return Calibration(rig, chain.where, scale, stated_topics, camera_sections, read_serials(named.values()))


def read_serials(sections: Iterable[Section]) -> tuple[str, ...]:
    """Return the distinct serial numbers in sections (our extension, which Kalibr ignores).

    Raises ConfigError.
    """
    values = (_read_serial(section) for section in sections if section.data.get(SERIAL) not in (None, ""))
    return tuple(dict.fromkeys(values))


def _read_serial(section: Section) -> str:
    serial = section.get(SERIAL)
    if not isinstance(serial, str):
        raise ConfigError(f"{section.where}: {SERIAL}: put it in quotes; YAML reads it as a number")
    if not re.fullmatch(r"[A-Za-z0-9_.-]{1,64}", serial):
        raise ConfigError(f"{section.where}: {SERIAL}: {serial!r:.40} is not a serial number; leave it out")
    return serial


@contextlib.contextmanager
def config_errors(where: str) -> Iterator[None]:
    """Within the block, a ValueError of a camera or rig becomes a ConfigError that names `where`."""
    try:
        yield
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None


def read_camera_yaml(path: Path) -> Calibration:
    """Read camera.yaml of a TUM RGB-D folder: a colour camera and its depth, registered or not."""
    top = read_yaml(path)
    cam0 = _read_camera(top)
    if "depth_intrinsics" in top:
        fx, fy, cx, cy = top.numbers("depth_intrinsics", (4,))
        width, height = _read_resolution(
            top, "depth_resolution" if "depth_resolution" in top else "resolution"
        )
        depth, T = _make_camera(top, width, height, (fx, fy, cx, cy)), top.pose("T_depth_cam0")
    else:  # registered: depth has the pixels of the undistorted colour image
        depth, T = replace(cam0, distortion=(), model=RADTAN), np.eye(4)
    rig = Rig(cam0=cam0, T_body_cam0=np.eye(4), depth=depth, T_depth_cam0=T)
    return Calibration(rig, str(path), top.number("depth_scale", positive=True), camera_sections=(top,))


def read_asl_calibration(cam0: Path, cam1: Path | None, imu0: Path | None) -> Calibration:
    """Read the sensor.yaml files of an ASL folder. Every sensor's T_BS is converted to the IMU's frame."""
    section = read_yaml(cam0)
    T_b_cam0 = section.pose("T_BS")
    rig = Rig(cam0=_read_camera(section), T_body_cam0=np.eye(4))
    if cam1:
        other = read_yaml(cam1)
        T_cam1_cam0 = se3.inverse(other.pose("T_BS")) @ T_b_cam0
        with config_errors(other.where):
            rig = replace(rig, cam1=_read_camera(other), T_cam1_cam0=T_cam1_cam0)
    if imu0:
        imu = read_yaml(imu0)
        T_imu_cam0 = se3.inverse(imu.pose("T_BS")) @ T_b_cam0
        rig = replace(rig, imu=imu_noise(imu, "rate_hz"), T_body_cam0=T_imu_cam0)
    return Calibration(rig, str(cam0))


def _read_camera(section: Section) -> Camera:
    model = section.text("camera_model", "pinhole")
    if model != "pinhole":
        raise ConfigError(f"{section.where}: camera_model '{model}' is not supported; supported: pinhole")
    fx, fy, cx, cy = section.numbers("intrinsics", (4,))
    width, height = _read_resolution(section, "resolution")
    return _make_camera(section, width, height, (fx, fy, cx, cy), *_read_distortion(section))


def _make_camera(
    section: Section,
    width: int,
    height: int,
    intrinsics: tuple[float, float, float, float],
    distortion: tuple[float, ...] = (),
    model: str = RADTAN,
) -> Camera:
    with config_errors(section.where):
        return Camera(width, height, *intrinsics, distortion, model)


def _read_resolution(section: Section, key: str) -> tuple[int, int]:
    width, height = section.numbers(key, (2,))
    if not (width.is_integer() and height.is_integer()):
        raise ConfigError(f"{section.where}: {key}: expected whole numbers, found {width:g} and {height:g}")
    return int(width), int(height)


def _read_distortion(section: Section) -> tuple[tuple[float, ...], str]:
    """Return distortion coefficients and lens model."""
    name = section.text("distortion_model", "none")
    if name == "none":
        return (), RADTAN
    model = lens_model(name)
    if model is None:
        raise ConfigError(
            f"{section.where}: distortion_model '{name}' is not supported; supported: {', '.join(_MODELS)}, "
            "none (calibrate again with one of these)"
        )
    key = "distortion_coeffs" if "distortion_coeffs" in section else "distortion_coefficients"
    return tuple(section.numbers(key, tuple(n for n in COEFFICIENT_COUNTS[model] if n))), model


def lens_model(name: str) -> str | None:
    """Return the lens model (`share.geometry.lens`) by its name in files; None if unknown."""
    return _MODELS.get(name)


def imu_noise(section: Section, rate: str) -> ImuNoise:
    """Read an IMU's noise under Kalibr's keys. rate: the key of its rate, Hz. Raises ConfigError."""
    keys = _NOISE_KEYS | {"rate_hz": rate}
    with config_errors(section.where):
        return ImuNoise(**{name: section.number(key, positive=True) for name, key in keys.items()})


def kalibr_T_imu_cam(cam: Section) -> F64:
    """Return T_imu_cam (4, 4) from `T_cam_imu` (Kalibr's: IMU coordinates to camera) or `T_imu_cam`."""
    if "T_cam_imu" in cam:
        return se3.inverse(cam.pose("T_cam_imu"))
    if "T_imu_cam" in cam:
        return cam.pose("T_imu_cam")
    raise ConfigError(f"{cam.where}: no extrinsics to the IMU; add T_cam_imu or T_imu_cam")


def _mean_timeshift_s(cams: Sequence[Section]) -> float:
    """Return IMU time minus camera time, s: the mean of the cameras' values, 0 without any."""
    shifts = [_read_timeshift_s(cam) for cam in cams if TIMESHIFT in cam]
    if shifts and max(shifts) - min(shifts) > _MAX_TIMESHIFT_SPREAD_S:
        raise ConfigError(
            f"{cams[-1].where}: {TIMESHIFT}: {shifts[-1]:g} s, but {shifts[0]:g} s for cam0; the cameras are "
            f"synchronised, so these must agree within {_MAX_TIMESHIFT_SPREAD_S:g} s"
        )
    return float(np.mean(shifts)) if shifts else 0.0


def _read_timeshift_s(cam: Section) -> float:
    shift = cam.number(TIMESHIFT)
    if abs(shift) > MAX_TIMESHIFT_S:
        raise ConfigError(
            f"{cam.where}: {TIMESHIFT}: {shift:g} s is more than {MAX_TIMESHIFT_S:g} s; give it in seconds"
        )
    return shift


def _kalibr_T_cam1_cam0(cam0: Section, cam1: Section) -> F64:
    """Return T_cam1_cam0 (4, 4) from `T_cn_cnm1` (coordinates of cam0, the previous camera, to cam1), else
    from both cameras' extrinsics to the IMU."""
    if "T_cn_cnm1" in cam1:
        return cam1.pose("T_cn_cnm1")
    if not ({"T_cam_imu", "T_imu_cam"} & cam1.data.keys()):
        raise ConfigError(f"{cam1.where}: no extrinsics to cam0; add T_cn_cnm1, T_cam_imu or T_imu_cam")
    return se3.inverse(kalibr_T_imu_cam(cam1)) @ kalibr_T_imu_cam(cam0)


# ---- Writing


def to_kalibr(rig: Rig, original: Calibration | None = None, serial: str | None = None) -> dict[str, Any]:
    """Return cam0, cam1, depth (our extension) and imu0 of a rig as plain data for a YAML file.

    original: the rig's earlier calibration, of which everything that a Rig does not hold is kept: topics,
    depth_scale and, for a rig without IMU, cam0's extrinsics to one and the timeshift. serial: of the device,
    written into each section, as Kalibr takes every top-level key for a camera. Raises ConfigError.
    """
    original = original or Calibration(rig, "")
    T_imu_cam0, shift_s = (
        (original.T_imu_cam0, original.timeshift_s) if rig.imu is None else (rig.T_body_cam0, rig.timeshift_s)
    )
    shift: dict[str, Any] = {TIMESHIFT: shift_s} if shift_s else {}  # absent means 0
    out = {"cam0": _kalibr_camera(rig.cam0) | shift}
    if T_imu_cam0 is not None:
        out["cam0"]["T_cam_imu"] = se3.inverse(T_imu_cam0).tolist()
        if rig.T_cam1_cam0 is not None:
            shift["T_cam_imu"] = (rig.T_cam1_cam0 @ se3.inverse(T_imu_cam0)).tolist()
    if rig.imu is not None:
        out["imu0"] = _kalibr_imu(rig.imu)
    if rig.cam1 is not None and rig.T_cam1_cam0 is not None:
        out["cam1"] = _kalibr_camera(rig.cam1) | shift | {"T_cn_cnm1": rig.T_cam1_cam0.tolist()}
    if rig.depth is not None and rig.T_depth_cam0 is not None:
        T = rig.T_depth_cam0.tolist()
        out["depth"] = _kalibr_camera(rig.depth) | {"T_depth_cam0": T, "depth_scale": original.depth_scale}
    for stream, topic in original.topics.items():
        name = "imu0" if stream == "imu" else stream
        if name in out:
            out[name]["rostopic"] = topic
    return {name: section | ({SERIAL: serial} if serial else {}) for name, section in out.items()}


def kalibr_texts(rig: Rig, remark: str, serial: str | None = None) -> dict[str, str]:
    """Return the texts of Kalibr's two chains by file name; only the camchain if the rig has no IMU.

    remark: a comment line for the top. serial: of the device.
    """
    data = to_kalibr(rig, serial=serial)
    parts = {CAMCHAIN: {k: v for k, v in data.items() if k != "imu0"}}
    if "imu0" in data:
        parts[IMU_CHAIN] = {"imu0": data["imu0"]}
    return {name: kalibr_text(part, remark) for name, part in parts.items()}


def kalibr_text(chain: dict[str, Any], *remarks: str) -> str:
    """Return the text of a chain of `to_kalibr` that Kalibr, OpenVINS and OpenCV's FileStorage read.

    remarks: comment lines for the top. Kalibr's own files always have a topic, and a timeshift where there
    is an IMU. OpenCV wants the directive of the first line, and lists further in than their key.
    """
    sections = {}
    for name, section in chain.items():
        topic = {"rostopic": DEFAULT_TOPICS[name]} if "rostopic" not in section else {}
        shift = {TIMESHIFT: 0.0} if "T_cam_imu" in section and TIMESHIFT not in section else {}
        sections[name] = section | shift | topic
    lines = ["%YAML 1.0", "---", *(f"# {remark}" for remark in remarks)]
    return "\n".join(lines) + "\n" + _yaml_text(sections)


def asl_camera_text(camera: Camera, T_bs: F64, rate_hz: float) -> str:
    """Return the text of a camera's sensor.yaml in an ASL folder. T_bs (4, 4): its pose in the IMU."""
    values = _kalibr_camera(camera)
    values["distortion_coefficients"] = values.pop("distortion_coeffs")
    if camera.distortion:
        values["distortion_model"] = EQUIDISTANT if camera.is_fisheye else "radial-tangential"
    return _asl_text("camera", T_bs, {"rate_hz": rate_hz} | values)


def asl_imu_text(imu: ImuNoise) -> str:
    """Return the text of the IMU's sensor.yaml in an ASL folder."""
    noise = _kalibr_imu(imu)
    return _asl_text("imu", np.eye(4), {"rate_hz": noise.pop("update_rate")} | noise)


def _asl_text(kind: str, T_bs: F64, values: dict[str, Any]) -> str:
    pose = {"rows": 4, "cols": 4, "data": T_bs.reshape(-1).tolist()}
    return "%YAML:1.0\n" + _yaml_text({"sensor_type": kind, "T_BS": pose, **values})


def _yaml_text(values: dict[str, Any]) -> str:
    import yaml

    class IndentedLists(yaml.SafeDumper):
        def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
            super().increase_indent(flow, False)

    dumped = yaml.dump(values, Dumper=IndentedLists, sort_keys=False, default_flow_style=None, width=1000)
    return str(dumped)


def _kalibr_camera(camera: Camera) -> dict[str, Any]:
    return {
        "camera_model": "pinhole",
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion_model": camera.model if camera.distortion else "none",
        "distortion_coeffs": list(camera.distortion),
        "resolution": [camera.width, camera.height],
    }


def _kalibr_imu(imu: ImuNoise) -> dict[str, Any]:
    return {key: getattr(imu, name) for name, key in _NOISE_KEYS.items()} | {"update_rate": imu.rate_hz}
