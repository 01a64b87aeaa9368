"""Write MCAP recordings, which Foxglove, rosbags and ROS 2 open as they are; recover those that were cut off.

Topics are those of `share.recordings.mcap.ros_messages.TOPICS`. The file grows as NAME.part, in chunks of at
most 256 kB (or one image), and gets its name when it is closed. After a crash `recover_recording` copies
every intact message of the `.part`. That has no index, and its last chunk may be incomplete: it is read
from the start, record by record, as far as possible.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import IO, Any, BinaryIO, NamedTuple

from share.errors import DataError, UsageError
from share.files.reading import open_regular
from share.files.writing import check_replaceable, new_file, open_new, sync_folder, write_errors
from share.geometry.camera import Rig
from share.recordings.images import EncodedImage
from share.recordings.mcap import rig as ros_rig
from share.recordings.mcap import ros_messages as ros
from share.recordings.mcap.file import BoundedFile, check_magic, chunk_records, damage_errors
from share.recordings.mcap.message_writer import CHUNK_BYTES, MessageWriter
from share.sensors.measurement import DEPTH, IMU, Measurement
from share.vision.image_codec import encode_jpeg

_FLUSH_PERIOD_NS = 10**9  # a crash loses at most this much


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
        self.path, self.part = check_replaceable(path), part_path(path)
        self._rig, self._jpeg, self._durable = rig, jpeg, durable
        try:
            self._file = self.part.open("xb") if durable else open_new(self.part)
        except FileExistsError:
            raise leftover_error(self.part) from None
        except OSError as error:
            raise UsageError(f"{self.part}: cannot be written: {error.strerror}") from None
        self._writer = MessageWriter(self._file)
        metadata = {"rig": ros_rig.rig_to_json(rig), "schema": "1"} | ({"serial": serial} if serial else {})
        self._writer.add_metadata(ros.RIG_RECORD, metadata)
        self._camera_infos = {
            stream: ros.encode(ros_rig.to_camera_info(camera, ros.make_header(0, stream)))
            for stream, camera in rig.cameras.items()
        }
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
                self._writer.write(ros.TF_STATIC, ros_rig.to_tf(self._rig, stamp), self._log_ns, latched=True)
            if measurement.stream == IMU:
                self._write_message(ros.TOPICS[IMU], ros.imu_message(stamp, measurement.payload))
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
        if (info := self._camera_infos.get(stream)) is not None:
            stamped = ros.with_stamp(info, stamp)
            self._writer.write_encoded(ros.INFO_TOPICS[stream], ros.CAMERA_INFO, stamped, self._log_ns)
        data = self._encode(image, is_depth)
        if data is None:
            self._write_message(topic, ros.encode_raw(header, image.load()))
        else:
            suffix = ros.SUFFIXES[is_depth]
            self._write_message(topic + suffix, ros.encode_compressed(header, data, is_depth))

    def _encode(self, image: Any, is_depth: bool) -> bytes | None:
        """Return the encoded image; None to write raw pixels."""
        if is_depth:
            mm = isinstance(image, EncodedImage) and image.depth_scale == ros.MILLIMETRES
            return image.read() if mm else None
        if self._jpeg is not None:
            return encode_jpeg(image.load(), self._jpeg)
        return image.read() if isinstance(image, EncodedImage) else None

    def _write_message(self, topic: str, message: Any) -> None:
        self._writer.write(topic, message, self._log_ns)

    def _flush(self, stamp: int) -> None:
        self._flushed_ns = stamp
        self._writer.flush()
        if self._durable:
            os.fdatasync(self._file.fileno())


# ---- Recovery of recordings that were cut off


class Recovered(NamedTuple):
    """messages: count by topic. lost_bytes: not readable. reason: why, empty if nothing was lost."""

    messages: dict[str, int]
    lost_bytes: int
    reason: str


def recover_recording(path: Path, out: Path, progress: Callable[[int], None] = lambda _: None) -> Recovered:
    """Copy all intact messages from `path` to `out`. progress: called with each number of bytes read.

    Raises UsageError for unusable paths, DataError if nothing can be recovered, ShareError if the disk of
    `out` is full or fails.
    """
    check_magic(path)
    if out.exists() and out.samefile(path):
        raise UsageError(f"--out {out} is the broken file itself; give another name")
    with open_regular(path) as file, new_file(out) as target:
        result = _copy(file, target, progress)
        if not result.messages:
            raise DataError(f"{path}: has no complete message ({result.reason or 'it is empty'})")
    return result


def _copy(file: BinaryIO, target: IO[bytes], progress: Callable[[int], None]) -> Recovered:
    from mcap.writer import Writer

    writer = Writer(target, chunk_size=CHUNK_BYTES)
    writer.start(profile="ros2", library="share")
    copier = _Copier(writer)
    lost_bytes, reason = _copy_records(file, copier, progress)
    writer.finish()
    return Recovered(copier.counts, lost_bytes, reason)


def _copy_records(file: BinaryIO, copier: _Copier, progress: Callable[[int], None]) -> tuple[int, str]:
    """Copy up to the first damaged record; return the bytes lost and why. A chunk damaged inside is skipped.

    Raises OSError if the copy cannot be written.
    """
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    records = StreamReader(BoundedFile(file), emit_chunks=True, record_size_limit=2**30).records
    lost_bytes, reason, intact_end = 0, "", 0
    while True:
        try:
            record = next(records, None)
        except damage_errors() as error:
            return lost_bytes + os.fstat(file.fileno()).st_size - intact_end, reason or _describe_error(error)
        if record is None:
            return lost_bytes, reason
        try:
            for part in chunk_records(record) if isinstance(record, Chunk) else [record]:
                copier.copy(part)
        except OSError:  # from writing: nothing is read here
            raise
        except damage_errors() as error:
            lost_bytes, reason = lost_bytes + file.tell() - intact_end, reason or _describe_error(error)
        progress(file.tell() - intact_end)
        intact_end = file.tell()


def _describe_error(error: Exception) -> str:
    if isinstance(error, OSError):
        return f"reading failed: {error.strerror}"
    name = type(error).__name__
    return "the file is cut short" if name == "EndOfFile" else f"damaged: {str(error) or name}"


class _Copier:
    """Writes schemas, channels, metadata and messages with the ids of the new file."""

    def __init__(self, writer: Any) -> None:
        self._writer = writer
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}
        self._names: dict[int, str] = {}
        self.counts: dict[str, int] = {}

    def copy(self, record: Any) -> None:
        kind = type(record).__name__
        if kind == "Schema" and record.id not in self._schemas:
            self._schemas[record.id] = self._writer.register_schema(record.name, record.encoding, record.data)
        elif kind == "Channel" and record.id not in self._channels:
            self._channels[record.id] = self._writer.register_channel(
                record.topic, record.message_encoding, self._schemas[record.schema_id], record.metadata
            )
            self._names[record.id] = record.topic
        elif kind == "Metadata":
            self._writer.add_metadata(record.name, record.metadata)
        elif kind == "Message":
            name = self._names[record.channel_id]
            self._writer.add_message(
                self._channels[record.channel_id], record.log_time, record.data, record.publish_time,
                record.sequence,
            )  # fmt: skip
            self.counts[name] = self.counts.get(name, 0) + 1
