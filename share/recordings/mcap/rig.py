"""The rig of an MCAP recording as ROS 2 messages: CameraInfo for each camera, /tf_static for the extrinsics.

Our recordings also contain the rig as JSON in an MCAP metadata record: exact to the last digit, and with the
IMU's noise, for which ROS has no message.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

import numpy as np

from share.errors import ConfigError, DataError
from share.files.json_file import parse_json
from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.geometry.lens import EQUIDISTANT, RADTAN
from share.recordings.calibration import config_errors
from share.recordings.mcap import ros_messages as ros
from share.recordings.mcap.file import damage_errors
from share.recordings.message_file import MessageFile
from share.sensors.measurement import CAM0, CAM1, DEPTH, IMU
from share.types import F64

_ROS_MODELS = {RADTAN: "plumb_bob", EQUIDISTANT: "equidistant"}
_RADTAN_NAMES, _FISHEYE_NAMES = ("plumb_bob", "none", ""), ("equidistant", "fisheye", "kannala_brandt")


def rig_to_json(rig: Rig) -> str:
    """Return a rig as JSON, with all numbers exact."""
    poses = {k: getattr(rig, k) for k in ("T_body_cam0", "T_cam1_cam0", "T_depth_cam0")}
    return json.dumps(
        {name: _camera_fields(camera) for name, camera in rig.cameras.items()}
        | {name: T.tolist() for name, T in poses.items() if T is not None}
        | ({"imu": asdict(rig.imu)} if rig.imu else {})
        | ({"timeshift_s": rig.timeshift_s} if rig.timeshift_s else {})
    )


def _camera_fields(camera: Camera) -> dict[str, Any]:
    """Return a camera's fields, without model radtan, which older records imply."""
    return {name: value for name, value in asdict(camera).items() if (name, value) != ("model", RADTAN)}


def rig_from_json(text: str, where: str) -> Rig:
    """Return the rig that `rig_to_json` wrote. Raises DataError."""
    try:
        data = parse_json(text)
        for name in (CAM0, CAM1, DEPTH):
            if name in data:
                data[name] = Camera(**{**data[name], "distortion": tuple(data[name]["distortion"])})
        if IMU in data:
            data[IMU] = ImuNoise(**data[IMU])
        return Rig(**data)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        raise DataError(f"{where}: its calibration record is damaged ({error}); give --calib") from None


def to_camera_info(camera: Camera, header: Any) -> Any:
    """Return a camera as CameraInfo."""
    D = np.array(camera.distortion or (0.0,) * 5)
    if not camera.is_fisheye:  # ROS has five coefficients for plumb_bob, four for equidistant
        D = np.pad(D, (0, 5 - len(D)))
    P = np.hstack([camera.K, np.zeros((3, 1))])
    roi = ros.make_message(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return ros.make_message(
        ros.CAMERA_INFO,
        header=header,
        height=camera.height,
        width=camera.width,
        distortion_model=_ROS_MODELS[camera.model],
        d=D,
        k=camera.K.reshape(9),
        r=np.eye(3).reshape(9),
        p=P.reshape(12),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def from_camera_info(info: Any, where: str) -> Camera:
    """Return the camera of a CameraInfo. Raises ConfigError if uncalibrated, or of an unsupported model."""
    D, fisheye = tuple(float(d) for d in info.d), info.distortion_model in _FISHEYE_NAMES
    while len(D) > (4 if fisheye else 5) and D[-1] == 0:
        D = D[:-1]
    if not fisheye and any(D) and (info.distortion_model not in _RADTAN_NAMES or len(D) > 5):
        raise ConfigError(
            f"{where}: distortion_model '{info.distortion_model}' is not supported; "
            "supported: plumb_bob, equidistant, none"
        )
    fx, _, cx, _, fy, cy, *_ = (float(k) for k in info.k)
    model = EQUIDISTANT if fisheye else RADTAN
    try:
        return Camera(info.width, info.height, fx, fy, cx, cy, D if any(D) or fisheye else (), model)
    except ValueError as error:
        raise ConfigError(f"{where}: {error}; give the calibration with --calib") from None


def to_tf(rig: Rig, stamp_ns: int, prefix: str = "") -> Any:
    """Return the extrinsics of a rig as transforms body -> cam0 -> cam1, depth. prefix: of frames' names."""
    edges = {(ros.BODY, CAM0): rig.T_body_cam0}
    if rig.T_cam1_cam0 is not None:
        edges[CAM0, CAM1] = se3.inverse(rig.T_cam1_cam0)
    if rig.T_depth_cam0 is not None:
        edges[CAM0, DEPTH] = se3.inverse(rig.T_depth_cam0)
    transforms = [
        to_transform(prefix + parent, prefix + child, T, stamp_ns) for (parent, child), T in edges.items()
    ]
    return ros.make_message(ros.TF, transforms=transforms)


def to_transform(parent: str, child: str, T: F64, stamp_ns: int) -> Any:
    """Return the pose T_parent_child (4, 4) as a TransformStamped."""
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = se3.quat_from_matrix(T[:3, :3]).tolist()
    return ros.make_message(
        "geometry_msgs/msg/TransformStamped",
        header=ros.make_header(stamp_ns, parent),
        child_frame_id=child,
        transform=ros.make_message(
            "geometry_msgs/msg/Transform",
            translation=ros.make_message("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=ros.make_message("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        ),
    )


class FrameTree:
    """Static transforms between named frames."""

    def __init__(self, messages: Iterable[Any], where: str) -> None:
        """messages: TFMessages. Raises DataError for a transform that is not rigid."""
        self._edges: dict[str, list[tuple[str, F64]]] = {}
        for transform in (t for message in messages for t in message.transforms):
            parent, child = transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/")
            p, q = transform.transform.translation, transform.transform.rotation
            quaternion = np.array([q.x, q.y, q.z, q.w])
            if not abs(np.linalg.norm(quaternion) - 1) < 1e-3 or not np.isfinite([p.x, p.y, p.z]).all():
                raise DataError(f"{where}: {parent} to {child} is not a rigid transform; give --calib")
            T = se3.from_quat(np.array([p.x, p.y, p.z]), quaternion)
            self._edges.setdefault(parent, []).append((child, T))
            self._edges.setdefault(child, []).append((parent, se3.inverse(T)))

    def find(self, a: str, b: str) -> F64 | None:
        """Return T_a_b (4, 4); None if nothing connects the two."""
        reached, todo = {a.lstrip("/"): np.eye(4)}, [a.lstrip("/")]
        while todo:
            frame = todo.pop()
            for other, T in self._edges.get(frame, []):
                if other not in reached:
                    reached[other] = reached[frame] @ T
                    todo.append(other)
        return reached.get(b.lstrip("/"))


# ---- The rig of a file


def own_rig(file: MessageFile, topics: dict[str, str], needed: bool) -> Rig | None:
    """Return the rig in our record of the file, else (if `needed`) that of CameraInfo; None if unknown."""
    record = _rig_record(file)
    if "rig" in record:
        return rig_from_json(record["rig"], str(file.path))
    return _rig_from_messages(file, topics) if needed else None


def own_serial(file: MessageFile) -> str | None:
    """Return the device's serial number; None if unknown."""
    return _rig_record(file).get("serial")


def _rig_record(file: MessageFile) -> dict[str, str]:
    """Return our metadata record of the device; empty for other recordings, or if damaged."""
    try:
        return file.metadata(ros.RIG_RECORD)
    except damage_errors():
        return {}


def _rig_from_messages(file: MessageFile, topics: dict[str, str]) -> Rig | None:
    """Return the rig of CameraInfo and /tf_static, None without cam0's CameraInfo.

    Raises ConfigError for a recording with an IMU: no message states its noise.
    """
    infos: dict[str, Any] = {s: _camera_info(file, topics[s]) for s in (CAM0, CAM1, DEPTH) if s in topics}
    if infos[CAM0] is None:
        return None
    if IMU in topics:
        raise ConfigError(
            f"{file.path}: noise and extrinsics of IMU {topics[IMU]} are missing; give a folder with both "
            "Kalibr chains with --calib, or only a camchain to track without the IMU"
        )
    missing = [topics[s] for s, info in infos.items() if info is None]
    if missing:
        raise ConfigError(f"{file.path}: {missing[0]} has no CameraInfo; give the calibration with --calib")
    where = str(file.path)
    transforms = (
        ros.decode(data, ros.TF, f"{where}: {ros.TF_STATIC}") for _, _, data in file.messages([ros.TF_STATIC])
    )
    tree = FrameTree(transforms, where)
    cams = {s: from_camera_info(info, f"{where}: {topics[s]}") for s, info in infos.items()}
    T = {s: tree.find(info.header.frame_id, infos[CAM0].header.frame_id) for s, info in infos.items()}
    if any(pose is None for pose in T.values()):
        raise ConfigError(f"{where}: /tf_static lacks the extrinsics of the cameras; give --calib")
    with config_errors(where):
        return Rig(cams[CAM0], np.eye(4), cams.get(CAM1), T.get(CAM1), cams.get(DEPTH), T.get(DEPTH))


def _camera_info(file: MessageFile, topic: str) -> Any | None:
    """Return the first CameraInfo of an image topic; None if there is none."""
    for suffix in ros.SUFFIXES:
        topic = topic.removesuffix(suffix)
    name = topic.rpartition("/")[0] + "/camera_info"
    if name not in file.topics:
        return None
    first = next(file.messages([name]), None)
    return None if first is None else ros.decode(first[2], ros.CAMERA_INFO, f"{file.path}: {name}")
