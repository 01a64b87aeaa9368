"""ROS 2 messages without ROS: the type store, the topics of a recording, stamps and schemas."""

from __future__ import annotations

from functools import cache
from typing import Any

from share.sensors.measurement import CAM0, CAM1, DEPTH, IMU

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

RIG_RECORD = "share.rig"  # name of the MCAP metadata record with the exact calibration


@cache
def typestore() -> Any:
    """Return rosbags' type store of ROS 2 Jazzy."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def make_message(name: str, **fields: Any) -> Any:
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


def encode(message: Any) -> bytes:
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def decode(data: bytes, name: str) -> Any:
    return typestore().deserialize_cdr(data, name)


def message_definition(name: str) -> bytes:
    """Return the definition of a message type, encoding `ros2msg`."""
    return str(typestore().generate_msgdef(name, ros_version=2)[0]).encode()
