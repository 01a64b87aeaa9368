"""A recording as the RealSense SDK writes it (`.db3`), of made-up images and samples, without the SDK."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from helpers.recordings import HEIGHT, WIDTH, depth_mm, picture

from share.recordings.mcap import ros_messages as ros

EYE = "/device_0/sensor_0/Infrared_1"
RIGHT = "/device_0/sensor_0/Infrared_2"
DEPTH = "/device_0/sensor_0/Depth_0"
ACCEL = "/device_0/sensor_2/Accel_0"
GYRO = "/device_0/sensor_2/Gyro_0"
SCHEMA = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
    " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)",
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,"
    " data BLOB NOT NULL)",
    "CREATE INDEX timestamp_idx ON messages (timestamp ASC)",
)


def text(said: str) -> bytes:
    return ros.encode(ros.make_message("std_msgs/msg/String", data=said))


def image(stamp_ns: int, data: bytes) -> bytes:
    return ros.encode(
        ros.make_message(
            ros.COMPRESSED,
            header=ros.make_header(stamp_ns, "x"),
            format="png",
            data=np.frombuffer(data, np.uint8),
        )
    )


def motion(stamp_ns: int, gyro: tuple[float, ...], accel: tuple[float, ...]) -> bytes:
    def vector(v: tuple[float, ...]) -> Any:
        return ros.make_message("geometry_msgs/msg/Vector3", x=v[0], y=v[1], z=v[2])

    zeros = np.zeros(9)
    return ros.encode(
        ros.make_message(
            ros.IMU_MSG,
            header=ros.make_header(stamp_ns, "x"),
            orientation=ros.make_message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=zeros,
            angular_velocity=vector(gyro),
            angular_velocity_covariance=zeros,
            linear_acceleration=vector(accel),
            linear_acceleration_covariance=zeros,
        )
    )


def make_db3(path: Path, frames: int = 12, texts: Mapping[str, str] | None = None) -> Path:
    """Stereo, depth and an IMU. texts: by topic, in place of what is said otherwise."""
    path.unlink(missing_ok=True)
    connection = sqlite3.connect(path)
    for statement in SCHEMA:
        connection.execute(statement)
    ids: dict[str, int] = {}

    def write(topic: str, at_ns: int, data: bytes) -> None:
        if topic not in ids:
            ids[topic] = len(ids) + 1
            connection.execute("INSERT INTO topics VALUES (?, ?, 'x', 'cdr', '')", (ids[topic], topic))
        row = ids[topic], at_ns, data
        connection.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)

    lens = f"width={WIDTH};height={HEIGHT};fx=50;fy=50;ppx=31.5;ppy=23.5;model=None;coeffs=0,0,0,0,0"
    said = {"/device_0/info": "Name=made;Serial Number=0123"}
    for k, stream in enumerate((EYE, RIGHT, DEPTH)):
        said |= {
            f"{stream}/camera_info": lens,
            f"{stream}/info": "fps=10",
            f"{stream}/tf/ref_0": f"rotation=1,0,0,0,1,0,0,0,1;translation={-0.05 * (k == 1)},0,0",
        }
    said |= {f"{stream}/info": "fps=200" for stream in (ACCEL, GYRO)}
    said["/device_0/sensor_0/option/Depth_Units/value"] = "0.001"
    for topic, what in {**said, **(texts or {})}.items():
        write(topic, 0, text(what))

    def sample(stream: str, number: int, at_ns: int, data: str, message: bytes) -> None:
        write(f"{stream}{data}", at_ns, message)
        reported = f"timestamp={at_ns / 1e6};timestamp_domain=Hardware Clock;Frame number={number}"
        write(f"{stream}{data[: data.rindex('/data')]}/metadata", at_ns, text(reported))

    for k in range(frames):
        for j in range(20):
            at = 10**9 + k * 10**8 + j * 5 * 10**6
            sample(ACCEL, 20 * k + j, at, "/imu/data", motion(at, (0, 0, 0), (0.0, -9.81, 0.0)))
            sample(GYRO, 20 * k + j, at, "/imu/data", motion(at, (0.0, 0.01, 0.0), (0, 0, 0)))
        at = 10**9 + k * 10**8 + 10**8 - 10**6
        for stream in (EYE, RIGHT):
            sample(stream, k, at, "/image/data/compressed", image(at, _png(picture(k))))
        sample(DEPTH, k, at, "/image/data/compressedDepth", image(at, bytes(12) + _png(depth_mm(k))))
    connection.commit()
    connection.close()
    return path


def _png(pixels: Any) -> bytes:
    return bytes(cv2.imencode(".png", pixels)[1])
