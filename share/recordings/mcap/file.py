"""Read an MCAP file by its index, with only a few chunks in memory."""

from __future__ import annotations

import heapq
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from share.errors import DataError, UsageError
from share.files.reading import open_regular
from share.recordings.losses import DataLosses
from share.recordings.mcap.chunks import MAX_HELD_BYTES, BoundedFile, chunk_records, read_summary
from share.types import I64

MAGIC = b"\x89MCAP0\r\n"
_MESSAGE_INDEX = 0x07
_RECORD_HEADER = struct.Struct("<BQ")
_INDEX_HEADER = struct.Struct("<HI")  # channel id, bytes of entries


class Topic(NamedTuple):
    """A topic. kind: ROS message type, e.g. sensor_msgs/msg/Image. channels: their ids."""

    name: str
    kind: str
    channels: tuple[int, ...]


def damage_errors() -> tuple[type[Exception], ...]:
    """Return the exceptions that the mcap library raises on a damaged file, and the system on a bad disk."""
    import zstandard
    from mcap.exceptions import McapError
    from mcap.stream_reader import CRCValidationError

    return (McapError, CRCValidationError, zstandard.ZstdError, ValueError, IndexError, zlib.error,
            struct.error, UnicodeDecodeError, EOFError, RuntimeError, KeyError, OverflowError, OSError,
            MemoryError)  # fmt: skip


def check_magic(path: Path) -> None:
    """Raise UsageError if a file cannot be read, DataError if it is not an MCAP file."""
    try:
        with open_regular(path) as file:
            head = file.read(len(MAGIC))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    if head != MAGIC:
        raise DataError(f"{path}: is not an MCAP file, or is empty")


class McapFile:
    """An MCAP file; every pass opens it again. Raises DataError if damaged or not closed properly."""

    def __init__(self, path: Path) -> None:
        self.path = path
        check_magic(path)
        self._check_index()

    @cached_property
    def topics(self) -> dict[str, Topic]:
        """Topics by name, those in CDR encoding only."""
        topics: dict[str, Topic] = {}
        for channel in self._summary.channels.values():
            schema = self._summary.schemas.get(channel.schema_id)
            if channel.message_encoding == "cdr" and schema is not None:
                known = topics.get(channel.topic)
                ids = (*known.channels, channel.id) if known else (channel.id,)
                topics[channel.topic] = Topic(channel.topic, schema.name, ids)
        return topics

    @cached_property
    def log_times(self) -> dict[str, I64]:
        """Sorted log times (N,) ns of each topic's messages, read from the index alone."""
        per_channel: dict[int, list[I64]] = {}
        with open_regular(self.path) as file:
            for chunk in self._summary.chunk_indexes:
                for channel, offset in chunk.message_index_offsets.items():
                    per_channel.setdefault(channel, []).append(self._read_index(file, offset))
        return {
            topic.name: np.sort(
                np.concatenate([t for c in topic.channels for t in per_channel.get(c, [_NO_TIMES])])
            )
            for topic in self.topics.values()
        }

    def metadata(self, name: str) -> dict[str, str]:
        """Return the metadata record `name`, or {}."""
        return dict(self._metadata.get(name, {}))

    @cached_property
    def _metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records by name; the last of several."""
        from mcap.data_stream import ReadDataStream
        from mcap.records import Metadata

        places = {index.name: index.offset for index in self._summary.metadata_indexes}
        records: dict[str, dict[str, str]] = {}
        with open_regular(self.path) as file:
            for name, offset in places.items():
                file.seek(offset + _RECORD_HEADER.size)
                records[name] = Metadata.read(ReadDataStream(BoundedFile(file))).metadata
        return records

    def messages(
        self,
        topics: Iterable[str],
        start_ns: int | None = None,
        end_ns: int | None = None,
        losses: DataLosses | None = None,
    ) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, log time, CDR bytes) in order of log time, within [start_ns, end_ns).

        losses: gets damaged chunks. Raises DataError if losses is None, or more than 5 % are damaged.
        """
        channels = {id: name for name in topics if name in self.topics for id in self.topics[name].channels}
        lo, hi = start_ns or 0, 2**64 if end_ns is None else end_ns
        waiting: list[
            tuple[int, int, int, Any]
        ] = [  # chunks and messages, by time, then by place in the file
            (chunk.message_start_time, chunk.chunk_start_offset, -1, chunk)
            for chunk in self._summary.chunk_indexes
            if chunk.message_end_time >= lo
            and chunk.message_start_time < hi
            and _may_have_messages(chunk, channels)
        ]
        heapq.heapify(waiting)
        total, held_bytes = len(waiting), 0
        with open_regular(self.path) as file:
            while waiting:
                at_ns, place, number, item = heapq.heappop(waiting)
                if number >= 0:
                    held_bytes -= len(item.data)
                    yield channels[item.channel_id], at_ns, item.data
                    continue
                for k, message in self._chunk_messages(file, item, losses, total):
                    if message.channel_id in channels and lo <= message.log_time < hi:
                        held_bytes += len(message.data)
                        heapq.heappush(waiting, (message.log_time, place, k, message))
                if held_bytes > MAX_HELD_BYTES:
                    raise self._damaged_error("too many of its chunks overlap in time")

    def _chunk_messages(
        self, file: IO[bytes], index: Any, losses: DataLosses | None, total: int
    ) -> Iterator[tuple[int, Any]]:
        """Yield the messages of a chunk, each with its index in it."""
        from mcap.data_stream import ReadDataStream
        from mcap.records import Chunk, Message

        try:
            file.seek(index.chunk_start_offset + _RECORD_HEADER.size)
            records = chunk_records(Chunk.read(ReadDataStream(BoundedFile(file))))
        except damage_errors() as error:
            damaged = self._damaged_error(str(error) or type(error).__name__)
            if losses is None:
                raise damaged from None
            losses.add(what := f"chunks of {self.path}", str(index.chunk_start_offset), str(damaged))
            losses.check(what, total)
            return
        yield from ((k, record) for k, record in enumerate(records) if isinstance(record, Message))

    @cached_property
    def _summary(self) -> Any:
        with open_regular(self.path) as file:
            try:
                return read_summary(file)
            except damage_errors():  # OSError: the file is shorter than a footer
                raise self._damaged_error("its end is missing") from None

    def _check_index(self) -> None:
        summary = self._summary
        if summary is None or (not summary.chunk_indexes and _message_count(summary) != 0):
            raise self._damaged_error("it has no index")

    def _damaged_error(self, reason: str) -> DataError:
        return DataError(
            f"{self.path}: is damaged or was not closed properly ({reason}); "
            f"try `share dataset recover {self.path} --out GOOD.mcap`"
        )

    def _read_index(self, file: IO[bytes], offset: int) -> I64:
        """Read the log times of a MessageIndex record (MCAP specification, op 0x07)."""
        file.seek(offset)
        head = file.read(_RECORD_HEADER.size + _INDEX_HEADER.size)
        try:
            opcode, _ = _RECORD_HEADER.unpack_from(head)
            _, size = _INDEX_HEADER.unpack_from(head, _RECORD_HEADER.size)
        except struct.error:
            raise self._damaged_error("its index is cut short") from None
        data = BoundedFile(file).read(size)
        if opcode != _MESSAGE_INDEX or len(data) != size or size % 16:
            raise self._damaged_error("its index is wrong")
        return np.frombuffer(data, "<i8").reshape(-1, 2)[:, 0].astype(np.int64)


_NO_TIMES = np.zeros(0, np.int64)


def _may_have_messages(chunk: Any, channels: Mapping[int, str]) -> bool:
    """Return whether a chunk may have messages of `channels`; one without an index may have any."""
    return not chunk.message_index_offsets or any(id in channels for id in chunk.message_index_offsets)


def _message_count(summary: Any) -> int | None:
    return None if summary.statistics is None else int(summary.statistics.message_count)
