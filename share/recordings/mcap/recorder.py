"""Write MCAP recordings with ROS 2 messages, which Foxglove, rosbags and ROS 2 open as they are.

Topics are those of `share.recordings.mcap.ros_messages.TOPICS`. The file grows as NAME.part, in chunks of at
most 256 kB (or one image), and gets its name when it is closed. After a crash,
`share.recordings.mcap.recover` recovers the `.part`.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from share.errors import DataError, UsageError
from share.files.writing import check_replaceable, open_new, sync_folder, write_errors
from share.geometry.camera import Rig
from share.recordings.images import EncodedImage, encode_jpeg
from share.recordings.mcap import images as ros_images
from share.recordings.mcap import rig as ros_rig
from share.recordings.mcap import ros_messages as ros
from share.sensors.measurement import DEPTH, IMU, Measurement
from share.types import F64

CHUNK_BYTES = 256 * 1024
_FLUSH_PERIOD_NS = 10**9  # a crash loses at most this much
_FOREVER = "{sec: 9223372036, nsec: 854775807}"
_LATCHED = {  # transient local: a player sends it to late subscribers too
    "offered_qos_profiles": "- {history: 1, depth: 1, reliability: 1, durability: 1, "
    f"deadline: {_FOREVER}, lifespan: {_FOREVER}, liveliness: 1, "
    f"liveliness_lease_duration: {_FOREVER}, avoid_ros_namespace_conventions: false}}\n"
}


def part_path(path: Path) -> Path:
    """Return the name of recording `path` while it grows."""
    return path.with_name(path.name + ".part")


def leftover_error(part: Path) -> UsageError:
    """Return the error for a recording that would overwrite another one's `.part`."""
    return UsageError(
        f"{part}: belongs to a recording that was cut off, or is still running; recover it with "
        f"`share dataset recover {part} --out {part.with_suffix('')}`, or give a new name"
    )


class Recorder:
    """Writes measurements to an MCAP file. Context manager; an exception inside leaves the `.part`.

    jpeg: quality for compressing gray images; None keeps encoded images byte for byte and raw ones raw.
    durable: for recordings that cannot be repeated: survive a power cut, at the price of one fdatasync per
    second, and never overwrite a `.part`. serial: of the device. Raises UsageError if the file cannot be
    created.
    """

    def __init__(
        self,
        path: Path,
        rig: Rig,
        jpeg: int | None = None,
        durable: bool = False,
        serial: str | None = None,
    ) -> None:
        from mcap.writer import Writer

        self.path, self.part = check_replaceable(path), part_path(path)
        self._rig, self._jpeg, self._durable = rig, jpeg, durable
        try:
            self._file = self.part.open("xb") if durable else open_new(self.part)
        except FileExistsError:
            raise leftover_error(self.part) from None
        except OSError as error:
            raise UsageError(f"{self.part}: cannot be written: {error.strerror}") from None
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)
        self._writer.start(profile="ros2", library="share")
        metadata = {"rig": ros_rig.rig_to_json(rig), "schema": "1"} | ({"serial": serial} if serial else {})
        self._writer.add_metadata(ros.RIG_RECORD, metadata)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._flushed_ns: int | None = None
        self._log_ns = 0

    def write(self, measurement: Measurement, log_ns: int | None = None) -> None:
        """Append one measurement. log_ns: the time by which readers sort, for stamps that wrap; default: the
        stamp. Raises DataError for a stamp before 1970 or after 2038, ShareError if the disk is full."""
        stamp = measurement.stamp_ns
        self._log_ns = stamp if log_ns is None else log_ns
        if not 0 <= stamp < 2**31 * 10**9:
            raise DataError(f"{self.path}: stamp {stamp} ns does not fit a ROS 2 message")
        with write_errors(self.path):
            if self._flushed_ns is None:
                self._write_rig(stamp)
            if measurement.stream == IMU:
                self._write_message(ros.TOPICS[IMU], _imu_message(stamp, measurement.payload))
            else:
                self._write_image(measurement.stream, stamp, measurement.payload)
            if self._flushed_ns is None or self._log_ns - self._flushed_ns >= _FLUSH_PERIOD_NS:
                self._flush(self._log_ns)

    def close(self) -> None:
        """Finish the file and rename it from `.part`."""
        with write_errors(self.path):
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            os.replace(self.part, self.path)
        sync_folder(self.path.parent)

    def abort(self) -> None:
        """Stop; the `.part` stays, with all that was written."""
        with contextlib.suppress(OSError):  # a full disk has been reported already
            self._writer.flush()
        with contextlib.suppress(OSError):
            self._file.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def _write_image(self, stream: str, stamp: int, image: Any) -> None:
        header, is_depth, topic = ros.make_header(stamp, stream), stream == DEPTH, ros.TOPICS[stream]
        data = self._encode(image, is_depth)
        if data is None:
            self._write_message(topic, ros_images.encode_raw(header, image.load()))
        else:
            suffix = ros.SUFFIXES[is_depth]
            self._write_message(topic + suffix, ros_images.encode_compressed(header, data, is_depth))

    def _encode(self, image: Any, is_depth: bool) -> bytes | None:
        """Return the encoded image; None to write raw pixels."""
        if is_depth:
            mm = isinstance(image, EncodedImage) and image.depth_scale == ros_images.MILLIMETRES
            return image.read() if mm else None
        if self._jpeg is not None:
            return encode_jpeg(image.load(), self._jpeg)
        return image.read() if isinstance(image, EncodedImage) else None

    def _write_rig(self, stamp: int) -> None:
        for stream, camera in ros_rig.rig_cameras(self._rig).items():
            info = ros_rig.to_camera_info(camera, ros.make_header(stamp, stream))
            self._write_message(ros.INFO_TOPICS[stream], info)
        self._write_message(ros.TF_STATIC, ros_rig.to_tf(self._rig, stamp), _LATCHED)

    def _write_message(self, topic: str, message: Any, metadata: dict[str, str] | None = None) -> None:
        if topic not in self._channels:
            kind = message.__msgtype__
            if kind not in self._schemas:
                self._schemas[kind] = self._writer.register_schema(
                    kind, "ros2msg", ros.message_definition(kind)
                )
            self._channels[topic] = self._writer.register_channel(
                topic, "cdr", self._schemas[kind], metadata or {}
            )
        number = self._counts[topic] = self._counts.get(topic, 0) + 1
        log_ns = self._log_ns
        self._writer.add_message(self._channels[topic], log_ns, ros.encode(message), log_ns, number)

    def _flush(self, stamp: int) -> None:
        self._flushed_ns = stamp
        self._writer.flush()
        if self._durable:
            os.fdatasync(self._file.fileno())


_UNKNOWN_COVARIANCE = np.zeros(9)
_NO_ORIENTATION = np.array([-1.0, *[0.0] * 8])  # sensor_msgs/Imu: -1 marks a missing orientation


def _imu_message(stamp: int, sample: F64) -> Any:
    wx, wy, wz, ax, ay, az = (float(value) for value in sample)
    return ros.make_message(
        ros.IMU_MSG,
        header=ros.make_header(stamp, ros_rig.BODY),
        orientation=ros.make_message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=_NO_ORIENTATION,
        angular_velocity=ros.make_message("geometry_msgs/msg/Vector3", x=wx, y=wy, z=wz),
        angular_velocity_covariance=_UNKNOWN_COVARIANCE,
        linear_acceleration=ros.make_message("geometry_msgs/msg/Vector3", x=ax, y=ay, z=az),
        linear_acceleration_covariance=_UNKNOWN_COVARIANCE,
    )
