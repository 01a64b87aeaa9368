"""Read RealSense SDK recordings (2.58 and later: `.db3`, a rosbag2 in SQLite) without the SDK.

The SDK's playback runs in threads that may hang and is not repeatable. Stamps are those of the metadata
beside each sample, as the device gave them; those of the table count from the start of the recording. Streams
are repaired as those of a live camera.
"""

from __future__ import annotations

import math
import re
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from share.checks import MAX_STAMP_NS, checked_pose
from share.errors import DataError, UsageError
from share.files.reading import MB, read_errors
from share.files.sqlite_file import UntrustedDatabase
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.recordings.calibration import Calibration
from share.recordings.calibration_match import device_mismatch, fit_to_recording
from share.recordings.images import EncodedImage
from share.recordings.losses import DataLosses
from share.recordings.mcap import ros_messages as ros
from share.recordings.recording import Recording, select_time_range
from share.sensors.measurement import CAM0, CAM1, DEPTH, IMU, Measurement
from share.sensors.profile import load_profile
from share.sensors.sample_processor import ACCEL, GYRO, DeviceSample, SampleProcessor
from share.sensors.sequencer import rig_streams
from share.types import F64, I64

STREAMS = {"Infrared_1": CAM0, "Infrared_2": CAM1, "Depth_0": DEPTH, "Accel_0": ACCEL, "Gyro_0": GYRO}
_DATA_SUFFIXES = ("/imu/data", "/image/data/compressed", "/image/data/compressedDepth")
_HARDWARE_CLOCK = "Hardware Clock"
_COLUMNS = {"topics": ("id", "name"), "messages": ("id", "topic_id", "timestamp", "data")}  # of rosbag2
_MAX_TOPICS, _MAX_NAME_LENGTH = 10_000, 500  # the SDK writes 100 topics with names of 60 characters
MAX_MESSAGE_BYTES = 64 * MB  # four times a raw 16-bit image of 8 megapixels
_MAX_ROW_BYTES = 4 * MAX_MESSAGE_BYTES
_UNIT_RANGE_M = (1e-6, 1.0)  # valid depth units
_RATE_RANGE_HZ = (0.1, 1e5)  # valid stream rates
_DEFAULT_PROFILE = "d435i"  # for the IMU, whose extrinsics and noise the SDK does not record
_DEFAULT_PROFILE_NOTE = (
    f"the recording has no IMU extrinsics and noise; using those of profile {_DEFAULT_PROFILE}; give --calib "
    "for this device's own"
)


def open_db3(path: Path, calibration: Calibration | None, frames: slice | None) -> RealSenseRecording:
    """Open the recording in `path`. Raises UsageError, DataError."""
    file = Db3(path)
    if CAM0 not in file.streams:
        raise UsageError(
            f"{path}: has no compressed left infrared images (Infrared 1); record with that stream"
        )
    if calibration is not None:
        notes = device_mismatch(calibration.serials, file.serial)
        return RealSenseRecording(file, calibration.rig, notes, frames)
    rig = read_recorded_rig(file)
    return RealSenseRecording(file, rig, (_DEFAULT_PROFILE_NOTE,) if rig.imu else (), frames)


class RealSenseRecording(Recording):
    """An SDK recording with the streams of its rig."""

    def __init__(self, file: Db3, rig: Rig, notes: tuple[str, ...], frames: slice | None) -> None:
        has_imu = file.streams.keys() >= {ACCEL, GYRO}
        recorded = {*file.streams, *((IMU,) if has_imu else ())}
        self.name, self.rig = file.path.stem, fit_to_recording(rig, recorded, file.path)
        self.notes, self.serial, self._file = notes, file.serial, file
        unit = f"{file.streams.get(DEPTH, '').rpartition('/')[0]}/option/Depth_Units/value"
        self._depth_scale = 1 / file.read_number(unit, None, 0.001, *_UNIT_RANGE_M)
        self.time_range = select_time_range(self.all_stamps()[CAM0], frames, str(file.path), rig.timeshift_ns)

    def all_stamps(self) -> dict[str, I64]:
        return self._stamps

    def measurements(self) -> Iterator[Measurement]:
        for m in self._repair(images=True):
            if self.is_in_time_range(m.stream, m.stamp_ns):
                yield m if m.stream == IMU else Measurement(m.stream, m.stamp_ns, self._image(m))

    @cached_property
    def _stamps(self) -> dict[str, I64]:
        stamps_by_stream: dict[str, list[int]] = {name: [] for name in rig_streams(self.rig)}
        for m in self._repair(images=False):
            stamps_by_stream[m.stream].append(m.stamp_ns)
        return {name: np.array(stamps, np.int64) for name, stamps in stamps_by_stream.items()}

    def _repair(self, images: bool) -> Iterator[Measurement]:
        streams = [*self.rig.cameras, *((ACCEL, GYRO) if self.rig.imu else ())]
        return repair_samples(self._file, streams, images, self.losses)

    def _image(self, m: Measurement) -> EncodedImage:
        camera, scale = self.rig.cameras[m.stream], self._depth_scale if m.stream == DEPTH else 0.0
        where = f"{self._file.path}: {m.stream} at {m.stamp_ns}"
        return EncodedImage(m.payload, where, camera.width, camera.height, scale)


def repair_samples(
    file: Db3, streams: Collection[str], images: bool, losses: DataLosses
) -> Iterator[Measurement]:
    """Yield the measurements of `streams`, repaired as a live camera's (`SampleProcessor`).

    images: with pixels. losses: gets damaged samples. Raises DataError.
    """
    rates = {
        name: file.read_number(f"{file.streams[name]}/info", "fps", 30.0, *_RATE_RANGE_HZ) for name in streams
    }
    intake = SampleProcessor(rates)
    for sample in file.samples(losses, images):
        yield from intake.feed(sample)
    yield from intake.flush()


def read_recorded_imu(file: Db3, losses: DataLosses) -> tuple[I64, F64]:
    """Return IMU stamps (N,) ns and values (N, 6) wx wy wz ax ay az, rad/s and m/s^2.

    losses: gets damaged samples. Raises DataError.
    """
    if missing := [name for name in (ACCEL, GYRO) if name not in file.streams]:
        raise DataError(f"{file.path}: has no {' and no '.join(missing)}; record both")
    samples = [(m.stamp_ns, m.payload) for m in repair_samples(file, (ACCEL, GYRO), False, losses)]
    if not samples:
        raise DataError(f"{file.path}: has no IMU samples")
    stamps, values = zip(*samples, strict=True)
    return np.array(stamps, np.int64), np.array(values)


def read_recorded_rig(file: Db3) -> Rig:
    """Return the rig: cameras as recorded, the IMU, if any, as in the default profile. Raises DataError."""
    lenses = {name: _read_camera(file, name) for name in (CAM0, CAM1, DEPTH) if name in file.streams}
    rig: dict[str, Any] = {"cam0": lenses[CAM0], "T_body_cam0": np.eye(4)}
    for name in (CAM1, DEPTH):
        if name in lenses:
            rig |= {
                name: lenses[name],
                f"T_{name}_cam0": _read_extrinsics(file, name) @ se3.inverse(_read_extrinsics(file, CAM0)),
            }
    if ACCEL in file.streams and GYRO in file.streams:
        default_rig = load_profile(_DEFAULT_PROFILE).rig()
        rig |= {"imu": default_rig.imu, "T_body_cam0": default_rig.T_body_cam0}
    try:
        return Rig(**rig)
    except ValueError as error:
        raise DataError(f"{file.path}: {error}") from None


def _read_camera(file: Db3, stream: str) -> Camera:
    fields = file.text_fields(f"{file.streams[stream]}/camera_info")
    try:
        width, height = int(fields["width"]), int(fields["height"])
        fx, fy, cx, cy = (float(fields[key]) for key in ("fx", "fy", "ppx", "ppy"))
        coefficients = tuple(float(c) for c in fields["coeffs"].split(","))
        if any(coefficients) and fields["model"] != "Brown Conrady":
            raise ValueError(f"distortion model {fields['model']} is not known; give --calib")
        return Camera(width, height, fx, fy, cx, cy, coefficients if any(coefficients) else ())
    except (KeyError, ValueError) as error:
        raise DataError(f"{file.path}: calibration of {stream}: {error}") from None


def _read_extrinsics(file: Db3, stream: str) -> F64:
    """Read T_stream_reference (4, 4); all streams share the reference. The rotation is stored by columns."""
    fields = file.text_fields(file.find_topic(f"{file.streams[stream]}/tf/ref_"))
    try:
        T = np.eye(4)
        T[:3, :3] = np.reshape([float(v) for v in fields["rotation"].split(",")], (3, 3), order="F")
        T[:3, 3] = [float(v) for v in fields["translation"].split(",")]
        return se3.orthonormal(checked_pose("extrinsics", T))
    except (KeyError, ValueError) as error:
        raise DataError(f"{file.path}: extrinsics of {stream}: {error}; give --calib") from None


# ---- The file


class Db3:
    """One file. streams: topic folder by stream. Raises DataError if it is not such a file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._topic_ids = self._read_topic_ids()
        parts = [(name.split("/"), name) for name in self._topic_ids if name.endswith(_DATA_SUFFIXES)]
        self._data_topics = {STREAMS[p[3]]: name for p, name in parts if len(p) > 3 and p[3] in STREAMS}
        self.streams = {stream: "/".join(name.split("/")[:4]) for stream, name in self._data_topics.items()}

    @property
    def serial(self) -> str | None:
        """Serial number of the device; None if unknown."""
        serial = self.text_fields("/device_0/info").get("Serial Number")
        return serial if serial is not None and re.fullmatch(r"[\w-]{1,64}", serial) else None

    def read_number(
        self, topic: str, key: str | None, default: float, minimum: float, maximum: float
    ) -> float:
        """Return the number under `key` of a text topic, or the whole text as a number if key is None.

        `default` if it is missing. Raises DataError if it is not a number from `minimum` to `maximum`.
        """
        fields = self.text_fields(topic)
        text = next(iter(fields), None) if key is None else fields.get(key)
        try:
            value = default if text is None else float(text)
        except ValueError:
            value = math.nan
        if not minimum <= value <= maximum:
            raise DataError(
                f"{self.path}: {topic}: '{text:.40}' is not a number from {minimum:g} to {maximum:g}"
            )
        return value

    def text_fields(self, topic: str) -> dict[str, str]:
        """Return the fields of a text topic, `key=value;key=value`; empty if it is missing."""
        query = f"SELECT {_bounded_data()} FROM messages NOT INDEXED WHERE topic_id = ? ORDER BY id LIMIT 1"
        for (data,) in self._rows(query, self._topic_ids.get(topic, -1)):
            return self._parse_text(data)
        return {}

    def find_topic(self, prefix: str) -> str:
        """Return the first topic whose name starts with `prefix`. Raises DataError if there is none."""
        for name in sorted(self._topic_ids):
            if name.startswith(prefix):
                return name
        raise DataError(f"{self.path}: has no topic {prefix}, which the SDK always writes")

    def samples(self, losses: DataLosses, images: bool = True) -> Iterator[DeviceSample]:
        """Yield all samples in the order of recording; damaged ones go to `losses`.

        images: with encoded pixels; else an image's payload is None. Raises DataError if more than 5 % of a
        stream are damaged.
        """
        data, metadata = {}, {}  # stream by topic id
        for stream, name in self._data_topics.items():
            data[self._topic_ids[name]] = stream
            metadata[self._topic_ids[self.find_topic(name[: name.rindex("/data")] + "/metadata")]] = stream
        read = [n for n, stream in data.items() if images or stream in (ACCEL, GYRO)] + list(metadata)
        marks = ", ".join("?" * len(read))
        query = (
            f"SELECT id, topic_id, timestamp, {_bounded_data()} FROM messages NOT INDEXED "
            f"WHERE topic_id IN ({marks}) ORDER BY id"
        )
        waiting: dict[str, Any] = {}
        total = dict.fromkeys(self._data_topics, 0)
        for row, number, at_ns, blob in self._rows(query, *read):
            if number in data:
                waiting[data[number]] = blob
                continue
            stream = metadata[number]
            total[stream] += 1
            try:
                with_payload = images or stream in (ACCEL, GYRO)
                sample = self._make_sample(
                    stream, waiting.pop(stream, None), with_payload, self._parse_text(blob), at_ns
                )
            except DataError as error:  # skip this sample only
                losses.add(f"samples of {stream}", str(row), str(error))
                continue
            yield sample
        for stream, count in total.items():
            losses.check(f"samples of {stream}", count)

    def _read_topic_ids(self) -> dict[str, int]:
        """Return the topics' ids by name."""
        query = (
            f"SELECT id, name FROM topics NOT INDEXED "
            f"WHERE typeof(name) = 'text' AND length(name) <= {_MAX_NAME_LENGTH} LIMIT {_MAX_TOPICS}"
        )
        return {name: number for number, name in self._rows(query)}

    def _make_sample(
        self, stream: str, blob: bytes | None, with_payload: bool, metadata: dict[str, str], at_ns: int
    ) -> DeviceSample:
        """Decode a sample. with_payload: else its payload is None. Raises DataError."""
        try:
            return DeviceSample(
                stream=stream,
                stamp_ns=_checked_int(round(float(metadata["timestamp"]) * 1e3) * 1000),
                payload=_decode_payload(stream, blob) if with_payload else None,
                arrived_ns=_checked_int(at_ns),
                number=None if stream in (ACCEL, GYRO) else _checked_int(int(metadata["Frame number"])),
                is_device_clock=metadata["timestamp_domain"] == _HARDWARE_CLOCK,
            )
        except Exception as error:
            raise DataError(f"{self.path}: a sample of {stream} cannot be read ({error!r})") from None

    def _parse_text(self, blob: bytes) -> dict[str, str]:
        text: str = ros.decode(blob, "std_msgs/msg/String", str(self.path)).data
        return {key: value for key, _, value in (item.partition("=") for item in text.split(";") if item)}

    def _rows(self, query: str, *values: int) -> Iterator[tuple[Any, ...]]:
        with read_errors(self.path):
            try:
                with closing(UntrustedDatabase(self.path, _COLUMNS, _MAX_ROW_BYTES)) as file:
                    yield from file.rows(query, *values)
            except (sqlite3.Error, MemoryError, OverflowError, UnicodeError) as error:
                raise DataError(
                    f"{self.path}: is not a recording of the RealSense SDK, or damaged: {error}"
                ) from None


def _bounded_data() -> str:
    """Return the SQL of a message's data, NULL if too large or not bytes."""
    return f"CASE WHEN typeof(data) = 'blob' AND length(data) <= {MAX_MESSAGE_BYTES} THEN data END"


def _checked_int(number: Any) -> int:
    """Return a stamp or frame number. Raises ValueError if it is out of range."""
    if type(number) is not int or abs(number) >= MAX_STAMP_NS:
        raise ValueError(f"{number!r:.40} is out of range")
    return number


def _decode_payload(stream: str, blob: bytes | None) -> Any:
    """Decode a message: (x, y, z) of an IMU, or an encoded image. Raises ValueError, rosbags' errors."""
    if blob is None:
        raise ValueError("its data is missing or too large")
    if stream in (ACCEL, GYRO):
        message = ros.decode(blob, ros.IMU_MSG, stream)
        v = message.linear_acceleration if stream == ACCEL else message.angular_velocity
        if not all(map(math.isfinite, (v.x, v.y, v.z))):
            raise ValueError("its values are not finite")
        return [v.x, v.y, v.z]
    image = ros.decode(blob, ros.COMPRESSED, stream).data.tobytes()
    return image[ros.DEPTH_HEADER_BYTES :] if stream == DEPTH else image
