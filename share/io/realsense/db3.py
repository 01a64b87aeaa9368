"""A recording by the maker's SDK (2.58 and later: `.db3`, a rosbag2 in SQLite), read without the SDK.

The SDK's own playback is not used: it plays in threads that may hang, and not the same twice. Stamps are
those of the metadata beside each sample, as the device gave them; the table's are the time since it began.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from share.core.intake import ACCEL, GYRO, Sample
from share.core.measurement import CAM0, CAM1, DEPTH
from share.errors import DataError
from share.io.mcap import types as ros

STREAMS = {"Infrared_1": CAM0, "Infrared_2": CAM1, "Depth_0": DEPTH, "Accel_0": ACCEL, "Gyro_0": GYRO}
_DATA = ("/imu/data", "/image/data/compressed", "/image/data/compressedDepth")
_DEPTH_HEADER = 12  # bytes of compressed_depth_image_transport's ConfigHeader before the PNG
_HARDWARE = "Hardware Clock"


class Db3:
    """`streams`: by our name, the folder of its topics. Raises DataError for a file that is none."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._ids: dict[str, int] = {
            name: number for number, name in self._rows("SELECT id, name FROM topics")
        }
        parts = [(name.split("/"), name) for name in self._ids if name.endswith(_DATA)]
        self._data = {STREAMS[p[3]]: name for p, name in parts if len(p) > 3 and p[3] in STREAMS}
        self.streams = {stream: "/".join(name.split("/")[:4]) for stream, name in self._data.items()}

    @property
    def serial(self) -> str | None:
        """Of the device."""
        return self.told("/device_0/info").get("Serial Number")

    def told(self, topic: str) -> dict[str, str]:
        """What a text such as `key=value;key=value` says, empty if it is not there."""
        for (data,) in self._rows(
            "SELECT data FROM messages WHERE topic_id = ? ORDER BY id LIMIT 1", self._ids.get(topic, -1)
        ):
            return self._text(data)
        return {}

    def topic(self, begins: str) -> str:
        """The first topic whose name begins so. Raises DataError if there is none."""
        for name in sorted(self._ids):
            if name.startswith(begins):
                return name
        raise DataError(f"{self.path}: has no {begins}, which the SDK writes")

    def samples(self, images: bool = True) -> Iterator[Sample]:
        """All of them as they came. images: with pixels, encoded; else an image's payload is None."""
        data = {self._ids[name]: stream for stream, name in self._data.items()}
        metadata = {self._ids[self.topic(_metadata(name))]: s for s, name in self._data.items()}
        read = [n for n, stream in data.items() if images or stream in (ACCEL, GYRO)] + list(metadata)
        marks = ", ".join("?" * len(read))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY id"
        waiting: dict[str, Any] = {}
        for number, at_ns, blob in self._rows(query, *read):
            if number in data:
                waiting[data[number]] = blob
            else:
                stream = metadata[number]
                yield self._sample(stream, waiting.pop(stream, None), self._text(blob), at_ns)

    def _sample(self, stream: str, blob: bytes | None, told: dict[str, str], at_ns: int) -> Sample:
        try:
            return Sample(
                stream=stream,
                stamp_ns=round(float(told["timestamp"]) * 1e3) * 1000,
                payload=None if blob is None else _payload(stream, blob),
                arrived_ns=at_ns,
                number=None if stream in (ACCEL, GYRO) else int(told["Frame number"]),
                hardware=told["timestamp_domain"] == _HARDWARE,
            )
        except Exception as error:  # rosbags raises many kinds on bytes that are no such message
            raise DataError(f"{self.path}: a sample of {stream} cannot be read ({error!r})") from None

    def _text(self, blob: bytes) -> dict[str, str]:
        try:
            text: str = ros.decode(blob, "std_msgs/msg/String").data
        except Exception as error:
            raise DataError(f"{self.path}: a message cannot be read ({error!r})") from None
        return {key: value for key, _, value in (item.partition("=") for item in text.split(";") if item)}

    def _rows(self, query: str, *values: int) -> Iterator[tuple[Any, ...]]:
        try:
            with closing(sqlite3.connect(f"file:{self.path}?mode=ro", uri=True)) as connection:
                yield from connection.execute(query, values)
        except sqlite3.Error as error:
            raise DataError(
                f"{self.path}: is no recording of the RealSense SDK, or damaged: {error}"
            ) from None


def _metadata(data: str) -> str:
    """The topic with the stamps of the samples in topic `data`."""
    return data[: data.rindex("/data")] + "/metadata"


def _payload(stream: str, blob: bytes) -> Any:
    if stream == ACCEL:
        a = ros.decode(blob, ros.IMU_MSG).linear_acceleration
        return [a.x, a.y, a.z]
    if stream == GYRO:
        w = ros.decode(blob, ros.IMU_MSG).angular_velocity
        return [w.x, w.y, w.z]
    image = ros.decode(blob, ros.COMPRESSED).data.tobytes()
    return image[_DEPTH_HEADER:] if stream == DEPTH else image
