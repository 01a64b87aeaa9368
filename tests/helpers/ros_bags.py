"""ROS bags of a recording, written by rosbags, as ROS would have recorded it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from share.recordings.mcap import ros_messages as ros
from share.recordings.recording import Source
from share.sensors.measurement import CAM0, CAM1, IMU

TOPICS = {CAM0: "/camera/infra1/image_rect_raw", CAM1: "/camera/infra2/image_rect_raw", IMU: "/camera/imu"}


def messages(source: Source, compressed: bool = False) -> list[tuple[str, int, Any]]:
    """(topic, stamp, ROS 2 message) of each sample."""
    out = []
    for m in source.measurements():
        if m.stream == IMU:
            out.append((TOPICS[IMU], m.stamp_ns, ros.imu_message(m.stamp_ns, m.payload)))
            continue
        header = ros.make_header(m.stamp_ns, m.stream)
        if compressed:
            message = ros.encode_compressed(header, m.payload.read(), is_depth=False)
            out.append((TOPICS[m.stream] + "/compressed", m.stamp_ns, message))
        else:
            out.append((TOPICS[m.stream], m.stamp_ns, ros.encode_raw(header, m.payload.load())))
    return out


def write_ros2(
    path: Path,
    written: list[tuple[str, int, Any]],
    storage: StoragePlugin,
    store: Stores = Stores.ROS2_HUMBLE,
) -> Path:
    types = get_typestore(store)
    with Writer2(path, version=8, storage_plugin=storage) as writer:
        connections: dict[str, Any] = {}
        for topic, stamp_ns, message in written:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=types)
            writer.write(connections[topic], stamp_ns, types.serialize_cdr(message, kind))
    return path


def write_split(
    path: Path, written: list[tuple[str, int, Any]], storage: StoragePlugin, parts: int = 3
) -> Path:
    """A bag in several files, as `ros2 bag record --max-bag-size` leaves it."""
    path.mkdir()
    names = []
    for number, part in enumerate(np.array_split(np.arange(len(written)), parts)):
        one = write_ros2(path.with_name(f"part{number}"), [written[i] for i in part], storage)
        (file,) = [f for f in one.iterdir() if f.name != "metadata.yaml"]
        names.append(f"{path.name}_{number}{file.suffix}")
        shutil.copy(file, path / names[-1])
    metadata = yaml.safe_load((one / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"]["relative_file_paths"] = names
    (path / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    return path


def write_ros1(
    path: Path, written: list[tuple[str, int, Any]], compression: str | None = None, chunk_bytes: int = 2**20
) -> Path:
    writer = Writer1(path)
    writer.chunk_threshold = chunk_bytes
    if compression:
        writer.set_compression(getattr(Writer1.CompressionFormat, compression))
    with writer:
        connections: dict[str, Any] = {}
        for topic, stamp_ns, message in written:
            kind = message.__msgtype__
            if topic not in connections:
                msgdef, md5sum = ros.typestore().generate_msgdef(kind, ros_version=1)
                connections[topic] = writer.add_connection(topic, kind, msgdef=msgdef, md5sum=md5sum)
            raw = ros.typestore().cdr_to_ros1(ros.encode(message), kind)
            writer.write(connections[topic], stamp_ns, raw)
    return path
