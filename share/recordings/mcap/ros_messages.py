"""ROS 2 messages without ROS: types, topics, stamps; images and IMU samples to messages and back."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from share.errors import DataError
from share.geometry.camera import Camera
from share.recordings.images import EncodedImage, check_size
from share.sensors.measurement import CAM0, CAM1, DEPTH, IMU, ImuSample
from share.types import F32, F64, I64
from share.vision.image_codec import depth_metres, image_format

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
IMU_MSG = "sensor_msgs/msg/Imu"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TF = "tf2_msgs/msg/TFMessage"

TF_STATIC = "/tf_static"
TOPICS = {CAM0: "/cam0/image_raw", CAM1: "/cam1/image_raw", DEPTH: "/depth/image_raw", IMU: "/imu0"}
INFO_TOPICS = {stream: f"/{stream}/camera_info" for stream in (CAM0, CAM1, DEPTH)}
SUFFIXES = ("/compressed", "/compressedDepth")  # of image_transport
DEPTH_HEADER_BYTES = 12  # compressed_depth_image_transport's ConfigHeader, before the PNG

BODY = "body"  # frame
RIG_RECORD = "share.rig"  # name of the MCAP metadata record with the exact calibration


@cache
def typestore() -> Any:
    """Return rosbags' type store of ROS 2 Jazzy."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def make_message(name: str, /, **fields: Any) -> Any:
    """Return a message of type `name`."""
    return typestore().types[name](**fields)


def make_header(stamp_ns: int, frame_id: str) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    stamp = make_message("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return make_message("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def stamp_of(message: Any) -> int:
    """Return the stamp of a message's header, ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def header_stamps(messages: list[bytes]) -> I64:
    """Return the header stamps (N,) ns of encoded messages, without decoding them."""
    pairs = np.frombuffer(b"".join(data[4:12] for data in messages), "<u4").reshape(-1, 2).astype(np.int64)
    return np.asarray(pairs[:, 0] * 10**9 + pairs[:, 1])


def with_stamp(data: bytes, stamp_ns: int) -> bytes:
    """Return an encoded message that begins with a header, with another stamp."""
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    return data[:4] + struct.pack("<iI", seconds, nanoseconds) + data[12:]


def encode(message: Any) -> bytes:
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def decode(data: bytes, name: str, where: str) -> Any:
    """Return the message of type `name`. Raises DataError that names `where`."""
    try:
        return typestore().deserialize_cdr(data, name)
    except Exception as error:  # rosbags raises many kinds on invalid bytes
        raise DataError(f"{where}: a message cannot be read ({error!r})") from None


def message_definition(name: str) -> bytes:
    """Return the definition of a message type, encoding `ros2msg`."""
    return str(typestore().generate_msgdef(name, ros_version=2)[0]).encode()


# ---- Images

MILLIMETRES = 1000.0  # 16UC1 depth is in mm, 32FC1 in m: ROS REP 118
_MAX_DEPTH_M = 1e4  # beyond any depth camera
_TO_GRAY = {
    "bgr8": cv2.COLOR_BGR2GRAY,
    "8UC3": cv2.COLOR_BGR2GRAY,
    "rgb8": cv2.COLOR_RGB2GRAY,
    "bgra8": cv2.COLOR_BGRA2GRAY,
    "8UC4": cv2.COLOR_BGRA2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY,
}
_CHANNELS = {"mono8": 1, "8UC1": 1, "bgr8": 3, "8UC3": 3, "rgb8": 3, "bgra8": 4, "8UC4": 4, "rgba8": 4}
_DEPTH_TYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


@dataclass(frozen=True, slots=True, eq=False)
class RawImage:
    """A `sensor_msgs/Image`, converted when loaded."""

    message: Any
    where: str
    camera: Camera
    is_depth: bool

    def load(self) -> NDArray[Any]:
        message, camera = self.message, self.camera
        check_size((message.width, message.height), (camera.width, camera.height), self.where)
        return self._depth() if self.is_depth else self._gray()

    def _gray(self) -> NDArray[Any]:
        encoding = self.message.encoding
        if encoding not in _CHANNELS:
            raise DataError(
                f"{self.where}: encoding '{encoding}' is not supported; supported: {', '.join(_CHANNELS)}"
            )
        pixels = self._pixels("u1", _CHANNELS[encoding])
        return (
            pixels[..., 0] if pixels.shape[2] == 1 else np.asarray(cv2.cvtColor(pixels, _TO_GRAY[encoding]))
        )

    def _depth(self) -> F32:
        encoding = self.message.encoding
        if encoding not in _DEPTH_TYPES:
            raise DataError(
                f"{self.where}: depth encoding '{encoding}' is not supported; "
                f"supported: {', '.join(_DEPTH_TYPES)}"
            )
        order = ">" if self.message.is_bigendian else "<"
        pixels = self._pixels(order + _DEPTH_TYPES[encoding], 1)[..., 0]
        if encoding != "32FC1":
            return depth_metres(pixels.astype(np.uint16), MILLIMETRES, self.where)
        metres = pixels.astype(np.float32)
        return np.where((metres > 0) & (metres < _MAX_DEPTH_M), metres, np.float32(0))

    def _pixels(self, dtype: str, channels: int) -> NDArray[Any]:
        """Return (H, W, channels) without the padding of rows. Raises DataError if data is missing."""
        height, width, step = self.message.height, self.message.width, self.message.step
        row = width * channels * np.dtype(dtype).itemsize
        data = np.ascontiguousarray(self.message.data)
        if step < row or len(data) < height * step:
            raise DataError(f"{self.where}: the image is cut short: {len(data)} of {height * step} bytes")
        rows = data[: height * step].reshape(height, step)[:, :row]
        return np.ascontiguousarray(rows).view(dtype).reshape(height, width, channels)


def decode_compressed(message: Any, where: str, camera: Camera, is_depth: bool) -> EncodedImage:
    """Convert a `CompressedImage`: JPEG or PNG; depth is a PNG, after a header if its format says so."""
    data = message.data.tobytes()
    if is_depth:
        if "rvl" in message.format.lower():
            raise DataError(f"{where}: RVL depth is not supported; record depth as PNG or raw")
        if "compressedDepth" in message.format:
            data = data[DEPTH_HEADER_BYTES:]
    return EncodedImage(data, where, camera.width, camera.height, MILLIMETRES if is_depth else 0.0)


def encode_compressed(header: Any, data: bytes, is_depth: bool) -> Any:
    """Make a `CompressedImage` of JPEG or PNG bytes; depth (16-bit PNG, mm) gets image_transport's header."""
    kind = "png" if image_format(data) == "png" else "jpeg"
    if is_depth:
        data, kind = bytes(DEPTH_HEADER_BYTES) + data, "16UC1; compressedDepth png"
    return make_message(COMPRESSED, header=header, format=kind, data=np.frombuffer(data, np.uint8))


def encode_raw(header: Any, image: NDArray[Any]) -> Any:
    """Make an `Image`: (H, W) uint8 as mono8; float32 m as 16UC1 mm if that is exact, else 32FC1."""
    if image.dtype == np.uint8:
        encoding = "mono8"
    else:
        encoding, image = _depth_encoding(image)
    image = np.ascontiguousarray(image)
    return make_message(
        IMAGE,
        header=header,
        height=image.shape[0],
        width=image.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=image.strides[0],
        data=image.view(np.uint8).reshape(-1),
    )


def _depth_encoding(depth: F32) -> tuple[str, NDArray[Any]]:
    mm = np.clip(np.rint(depth * np.float32(MILLIMETRES)), 0, 65535).astype(np.uint16)
    if np.array_equal(mm / np.float32(MILLIMETRES), depth):
        return "16UC1", mm
    return "32FC1", depth


# ---- IMU samples

_LITTLE_ENDIAN = 1  # bit of byte 1 of the encapsulation header (OMG DDSI-RTPS 10.2)
_NUMBERS = 4 + 9 + 3 + 9 + 3 + 9  # doubles: orientation, rate and acceleration, each with its covariance
_RATE, _FORCE = slice(13, 16), slice(25, 28)
_UNKNOWN_COVARIANCE = np.zeros(9)
_NO_ORIENTATION = np.array([-1.0, *[0.0] * 8])  # sensor_msgs/Imu: -1 marks a missing orientation


def imu_message(stamp: int, sample: ImuSample, frame: str = BODY) -> Any:
    wx, wy, wz, ax, ay, az = (float(value) for value in sample)
    return make_message(
        IMU_MSG,
        header=make_header(stamp, frame),
        orientation=make_message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=_NO_ORIENTATION,
        angular_velocity=make_message("geometry_msgs/msg/Vector3", x=wx, y=wy, z=wz),
        angular_velocity_covariance=_UNKNOWN_COVARIANCE,
        linear_acceleration=make_message("geometry_msgs/msg/Vector3", x=ax, y=ay, z=az),
        linear_acceleration_covariance=_UNKNOWN_COVARIANCE,
    )


def imu_values(message: Any, where: str) -> ImuSample:
    """Return the sample of an IMU message. Raises DataError if it is not finite."""
    w, a = message.angular_velocity, message.linear_acceleration
    values = (w.x, w.y, w.z, a.x, a.y, a.z)
    if not math.isfinite(sum(values)):
        raise DataError(f"{where}: the sample has values that are not finite")
    return values


def is_imu_message(data: bytes) -> bool:
    """Return whether a message is sensor_msgs/Imu in little-endian CDR.

    Layout: stamp, frame name of any length, doubles to the end.
    """
    return len(data) >= 16 and data[1] & 1 == _LITTLE_ENDIAN and len(data) == _expected_size(data)


def parse_imu_batch(batch: list[bytes]) -> F64:
    """Return the values (N, 6) of IMU messages, rad/s and m/s^2."""
    tails = np.frombuffer(b"".join(data[-8 * _NUMBERS :] for data in batch), "<f8").reshape(-1, _NUMBERS)
    return np.concatenate([tails[:, _RATE], tails[:, _FORCE]], axis=1)


def _expected_size(data: bytes) -> int:
    """Return the size of a message by the length of its frame name; doubles are aligned to 8 bytes."""
    name_end = 12 + int.from_bytes(data[12:16], "little")
    return 4 + -(-name_end // 8) * 8 + 8 * _NUMBERS
