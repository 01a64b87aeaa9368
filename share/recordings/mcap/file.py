"""Read an untrusted MCAP file by its index: few chunks in memory, every declared size and offset checked.

A few kilobytes of zstd or lz4 can unpack to gigabytes, a record may claim to be longer than its file, and an
index may point anywhere, many times: the mcap library's own reader would follow. The file's own size bounds
all of it.
"""

from __future__ import annotations

import heapq
import os
import struct
import zlib
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import IO, Any

import numpy as np

from share.errors import DataError, UsageError
from share.files.reading import MB, open_regular, read_errors
from share.recordings.losses import DataLosses
from share.recordings.message_file import MessageFile, Messages, Topic
from share.types import I64

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES = 128 * MB  # unpacked; writers close a chunk at 0.2 to 4 MB, or after a single image
MAX_HELD_BYTES = 4 * MAX_CHUNK_BYTES  # messages in memory of chunks that overlap in time
_MAX_WINDOW_LOG2 = 27  # zstd window, log2 of bytes
_MESSAGE_INDEX = 0x07
_RECORD_HEADER = struct.Struct("<BQ")
_INDEX_HEADER = struct.Struct("<HI")  # channel id, bytes of entries


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
    with read_errors(path, UsageError), open_regular(path) as file:
        head = file.read(len(MAGIC))
    if head != MAGIC:
        raise DataError(f"{path}: is not an MCAP file, or is empty")


class McapFile(MessageFile):
    """An MCAP file; every pass opens it again. Raises DataError if damaged or not closed properly."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        check_magic(path)
        summary = self._summary
        is_empty = summary and summary.statistics and not summary.statistics.message_count
        if summary is None or not (summary.chunk_indexes or is_empty):
            raise self._damaged_error("it has no index")

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
    def _channel_times(self) -> dict[int, I64]:
        """Read from the index alone."""
        out: dict[int, list[I64]] = {}
        with open_regular(self.path) as file:
            for chunk in self._summary.chunk_indexes:
                for channel, offset in chunk.message_index_offsets.items():
                    out.setdefault(channel, []).append(self._read_index(file, offset))
        return {channel: np.concatenate(times) for channel, times in out.items()}

    def metadata(self, name: str) -> dict[str, str]:
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

    def _times(self, topic: Topic) -> list[I64]:
        return [self._channel_times[id] for id in topic.channels if id in self._channel_times]

    def _read(self, topics: list[str], start_ns: int, end_ns: int, losses: DataLosses | None) -> Messages:
        """Losses are whole chunks."""
        channels = self.channels(topics)
        # chunks and messages by time, then by place in the file; a chunk without an index may have any
        waiting: list[tuple[int, int, int, Any]] = [
            (chunk.message_start_time, chunk.chunk_start_offset, -1, chunk)
            for chunk in self._summary.chunk_indexes
            if chunk.message_end_time >= start_ns
            and chunk.message_start_time < end_ns
            and (not chunk.message_index_offsets or channels.keys() & chunk.message_index_offsets)
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
                    if message.channel_id in channels and start_ns <= message.log_time < end_ns:
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


# ---- Chunks and summary


class BoundedFile:
    """A file that reads at most what is left: Python allocates the requested size beforehand."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        self.seek, self.tell = file.seek, file.tell

    def read(self, count: int = -1) -> bytes:
        left = max(0, self._size - self._file.tell())
        return self._file.read(left if count < 0 else min(count, left))


def chunk_records(chunk: Any) -> list[Any]:
    """Return the records in a chunk. Raises the errors in `damage_errors`."""
    from mcap.records import Chunk
    from mcap.stream_reader import CRCValidationError, breakup_chunk

    data = _decompress(chunk)
    if chunk.uncompressed_crc and (crc := zlib.crc32(data)) != chunk.uncompressed_crc:
        raise CRCValidationError(chunk.uncompressed_crc, crc, chunk)
    plain = Chunk("", data, chunk.message_end_time, chunk.message_start_time, 0, len(data))
    return list(breakup_chunk(plain))


def _decompress(chunk: Any) -> bytes:
    """Unpack a chunk to exactly its declared size; never hold more than that."""
    from mcap.exceptions import McapError, UnsupportedCompressionError

    declared_size = chunk.uncompressed_size
    if declared_size > MAX_CHUNK_BYTES:
        raise McapError(f"a chunk has {declared_size / MB:,.0f} MB, the limit is {MAX_CHUNK_BYTES / MB:g}")
    match chunk.compression:
        case "zstd":
            data = _decompress_zstd(chunk.data, declared_size)
        case "lz4":
            import lz4.frame  # type: ignore[import-untyped]

            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=declared_size + 1)
        case "":
            data = chunk.data
        case other:
            raise UnsupportedCompressionError(other)
    if len(data) != declared_size:
        raise McapError(f"a chunk does not unpack to its declared {declared_size} bytes")
    return data


def _decompress_zstd(data: bytes, declared_size: int) -> bytes:
    import zstandard
    from mcap.exceptions import McapError

    head = zstandard.get_frame_parameters(data)
    if (
        head.content_size not in (declared_size, zstandard.CONTENTSIZE_UNKNOWN)
        or head.window_size > 1 << _MAX_WINDOW_LOG2
    ):
        raise McapError(f"a chunk declares {declared_size} bytes, its zstd frame {head.content_size}")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=declared_size + 1)


def read_summary(file: IO[bytes]) -> Any | None:
    """Return the summary at the end of a file; None if it has none.

    Raises the errors in `damage_errors`; McapError also for chunks that overlap or lie outside the file.
    """
    from mcap.exceptions import McapError
    from mcap.reader import FOOTER_SIZE
    from mcap.records import Footer
    from mcap.stream_reader import MAGIC_SIZE

    size = os.fstat(file.fileno()).st_size
    file.seek(size - FOOTER_SIZE - MAGIC_SIZE)
    footer = next(_records(file))
    if not isinstance(footer, Footer):
        raise McapError("it has no footer")
    if footer.summary_start == 0:
        return None
    file.seek(footer.summary_start)
    summary = _collect_summary(_records(file))
    _check_index_offsets(summary, size)
    return summary


def _records(file: IO[bytes]) -> Any:
    """Iterate over the records from the position of `file`; chunks are not unpacked."""
    from mcap.stream_reader import StreamReader

    return StreamReader(BoundedFile(file), skip_magic=True, emit_chunks=True, record_size_limit=2**30).records


def _collect_summary(records: Any) -> Any:
    from mcap import records as kinds
    from mcap.summary import Summary

    summary = Summary()
    for record in records:
        match record:
            case kinds.Statistics():
                summary.statistics = record
            case kinds.Schema():
                summary.schemas[record.id] = record
            case kinds.Channel():
                summary.channels[record.id] = record
            case kinds.ChunkIndex():
                summary.chunk_indexes.append(record)
            case kinds.MetadataIndex():
                summary.metadata_indexes.append(record)
    return summary


def _check_index_offsets(summary: Any, size: int) -> None:
    """Raise McapError unless reading all chunks reads each byte of the file at most once."""
    from mcap.exceptions import McapError

    end = 0
    for chunk in sorted(summary.chunk_indexes, key=lambda chunk: int(chunk.chunk_start_offset)):
        index = chunk.chunk_start_offset + chunk.chunk_length
        after = index + chunk.message_index_length
        offsets = chunk.message_index_offsets
        if chunk.chunk_start_offset < end or after > size or chunk.chunk_length < _RECORD_HEADER.size:
            raise McapError("its index points out of the file, or to one chunk twice")
        if (
            any(not index <= offset < after for offset in offsets.values())
            or offsets.keys() - summary.channels
        ):
            raise McapError("its index points to messages outside of its chunks")
        end = after
