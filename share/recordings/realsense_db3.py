"""Read files of the RealSense SDK (2.58 and later: `.db3`, a rosbag2 in SQLite) without the SDK.

The SDK's playback runs in threads that may hang and is not repeatable. Stamps are those of the metadata
beside each sample, as the device gave them; those of the table count from the start of the recording.
"""

from __future__ import annotations

import math
import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from share.errors import DataError
from share.files.reading import MB
from share.files.sqlite_file import UntrustedDatabase
from share.recordings.losses import DataLosses
from share.recordings.mcap import ros_messages as ros
from share.recordings.tables import MAX_STAMP_NS
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.sensors.sample_processor import ACCEL, GYRO, DeviceSample

STREAMS = {"Infrared_1": CAM0, "Infrared_2": CAM1, "Depth_0": DEPTH, "Accel_0": ACCEL, "Gyro_0": GYRO}
_DATA_SUFFIXES = ("/imu/data", "/image/data/compressed", "/image/data/compressedDepth")
_HARDWARE_CLOCK = "Hardware Clock"
_COLUMNS = {"topics": ("id", "name"), "messages": ("id", "topic_id", "timestamp", "data")}  # of rosbag2
_MAX_TOPICS, _MAX_NAME_LENGTH = 10_000, 500  # the SDK writes 100 topics with names of 60 characters
_MAX_MESSAGE_BYTES = 64 * MB  # four times a raw 16-bit image of 8 megapixels
_MAX_ROW_BYTES = 4 * _MAX_MESSAGE_BYTES


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
        query = f"SELECT {_DATA_OR_NULL} FROM messages NOT INDEXED WHERE topic_id = ? ORDER BY id LIMIT 1"
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
        data = {self._topic_ids[name]: stream for stream, name in self._data_topics.items()}
        metadata = {
            self._topic_ids[self.find_topic(_metadata_topic(name))]: s
            for s, name in self._data_topics.items()
        }
        read = [n for n, stream in data.items() if images or stream in (ACCEL, GYRO)] + list(metadata)
        marks = ", ".join("?" * len(read))
        query = (
            f"SELECT id, topic_id, timestamp, {_DATA_OR_NULL} FROM messages NOT INDEXED "
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
        except Exception as error:  # rosbags raises many kinds on invalid bytes
            raise DataError(f"{self.path}: a sample of {stream} cannot be read ({error!r})") from None

    def _parse_text(self, blob: bytes) -> dict[str, str]:
        try:
            text: str = ros.decode(blob, "std_msgs/msg/String").data
        except Exception as error:
            raise DataError(f"{self.path}: a message cannot be read ({error!r})") from None
        return {key: value for key, _, value in (item.partition("=") for item in text.split(";") if item)}

    def _rows(self, query: str, *values: int) -> Iterator[tuple[Any, ...]]:
        try:
            with closing(UntrustedDatabase(self.path, _COLUMNS, _MAX_ROW_BYTES)) as file:
                yield from file.rows(query, *values)
        except OSError as error:
            raise DataError(f"{self.path}: cannot be read: {error.strerror}") from None
        except (sqlite3.Error, MemoryError, OverflowError, UnicodeError) as error:
            raise DataError(
                f"{self.path}: is not a recording of the RealSense SDK, or damaged: {error}"
            ) from None


_DATA_OR_NULL = f"CASE WHEN typeof(data) = 'blob' AND length(data) <= {_MAX_MESSAGE_BYTES} THEN data END"


def _checked_int(number: Any) -> int:
    """Return a stamp or frame number. Raises ValueError if it is out of range."""
    if type(number) is not int or abs(number) >= MAX_STAMP_NS:
        raise ValueError(f"{number!r:.40} is out of range")
    return number


def _metadata_topic(data: str) -> str:
    """Return the topic with the metadata of the samples in topic `data`."""
    return data[: data.rindex("/data")] + "/metadata"


def _decode_payload(stream: str, blob: bytes | None) -> Any:
    """Decode a message: (x, y, z) of an IMU, or an encoded image. Raises ValueError, rosbags' errors."""
    if blob is None:
        raise ValueError("its data is missing or too large")
    if stream in (ACCEL, GYRO):
        message = ros.decode(blob, ros.IMU_MSG)
        v = message.linear_acceleration if stream == ACCEL else message.angular_velocity
        if not all(map(math.isfinite, (v.x, v.y, v.z))):
            raise ValueError("its values are not finite")
        return [v.x, v.y, v.z]
    image = ros.decode(blob, ros.COMPRESSED).data.tobytes()
    return image[ros.DEPTH_HEADER_BYTES :] if stream == DEPTH else image
