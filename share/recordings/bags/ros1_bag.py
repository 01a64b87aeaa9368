"""Read an untrusted ROS 1 bag (`.bag`, format 2.0) by rosbags, its messages converted to ROS 2's CDR.

rosbags unpacks chunks whatever they grow to, reads as much as a length says, and where chunks overlap in time
unpacks one for each message. Here sizes and lengths are bounded, and each chunk is unpacked once. As bz2
makes a millionth of zeros, what is unpacked altogether is bounded by the size of the file, too.
"""

from __future__ import annotations

import bz2
import heapq
import struct
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from functools import cached_property, partial
from io import SEEK_CUR, BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from share.errors import DataError
from share.files.reading import MB, open_regular, read_errors
from share.recordings.losses import DataLosses
from share.recordings.mcap import ros_messages as ros
from share.recordings.mcap.file import MAX_CHUNK_BYTES, MAX_HELD_BYTES, BoundedFile
from share.recordings.message_file import MessageFile, Messages, Topic
from share.types import I64

_MAX_RATIO = 256  # unpacked bytes of all chunks to those of the file; of lz4 they are never more
_SMALL_BYTES = 4_000 * MB  # that may be unpacked of any file
_MAX_SKIPPED = 16  # connection records before a message, which its index points to
_MAX_HEADER_BYTES = 10_000  # of a record in a chunk: a topic's name is the longest part


class Ros1Bag(MessageFile):
    """A ROS 1 bag. Raises DataError if it is damaged or has no index."""

    @cached_property
    def topics(self) -> Mapping[str, Topic]:
        """Topics by name, of types that ROS 2 has as standard."""
        known, out = ros.typestore().types, dict[str, Topic]()
        with self._opened() as reader:
            for connection in reader.connections:
                if connection.msgtype in known:
                    ids = out[connection.topic].channels if connection.topic in out else ()
                    out[connection.topic] = Topic(connection.topic, connection.msgtype, (*ids, connection.id))
        return out

    @cached_property
    def _channel_times(self) -> dict[int, I64]:
        with self._opened() as reader:
            return {id: np.array([e.time for e in index], np.int64) for id, index in reader.indexes.items()}

    def _times(self, topic: Topic) -> list[I64]:
        return [self._channel_times[id] for id in topic.channels if id in self._channel_times]

    def _read(self, topics: list[str], start_ns: int, end_ns: int, losses: DataLosses | None) -> Messages:
        """A damaged chunk ends the reading with a DataError."""
        channels = self.channels(topics)
        if not channels:
            return
        max_unpacked = max(_SMALL_BYTES, _MAX_RATIO * self.path.stat().st_size)
        with self._opened() as reader:
            kinds = {one.id: one.msgtype for one in reader.connections}
            for stamp_ns, id, data in _stored_messages(reader, channels, start_ns, end_ns, max_unpacked):
                try:
                    cdr = bytes(ros.typestore().ros1_to_cdr(data, kinds[id]))
                except _conversion_errors() as error:
                    reason = f"{self.path}: {channels[id]} at {stamp_ns}: cannot be read ({error})"
                    if losses is None:
                        raise DataError(reason) from None
                    losses.add(f"messages of {channels[id]}", str(stamp_ns), reason)
                else:
                    yield channels[id], stamp_ns, cdr

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        """Yield rosbags' reader of this file. Errors in the block that damage can cause become DataError."""
        from rosbags.rosbag1 import Reader, ReaderError

        with read_errors(self.path):
            try:
                reader = Reader(_RegularFile(self.path))
                reader.open()
                with closing(reader):
                    _check_places(reader.chunks.values())
                    yield reader
            except DataError:
                raise
            except (ReaderError, AssertionError, *_conversion_errors()) as error:
                advice = "`rosbag reindex` may mend it"
                text = str(error) or type(error).__name__
                raise DataError(f"{self.path}: is not a ROS 1 bag, or damaged: {text}; {advice}") from None


class _RegularFile:
    """A path as rosbags takes it, opened with bounded reads."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def exists(self) -> bool:
        return self._path.exists()

    def open(self, mode: str) -> Any:
        file = open_regular(self._path)
        bounded: Any = BoundedFile(file)
        bounded.close = file.close
        bounded.readline = partial(file.readline, 100)
        return bounded

    def __str__(self) -> str:
        return str(self._path)


def _stored_messages(
    reader: Any, channels: Collection[int], start_ns: int, end_ns: int, max_unpacked: int
) -> Iterator[tuple[int, int, bytes]]:
    """Yield log time ns, channel and data of the messages within [start_ns, end_ns), by time.

    Raises ValueError where chunks overlap in time so much that more than MAX_HELD_BYTES wait for their turn,
    DataError where they unpack to more than `max_unpacked` bytes.
    """
    wanted: dict[int, list[tuple[int, int, int]]] = {}  # time, offset, channel, by place of the chunk
    for id in channels:
        for time_ns, place, offset in reader.indexes.get(id, ()):
            if start_ns <= time_ns < end_ns:
                wanted.setdefault(place, []).append((time_ns, offset, id))
    # chunks and messages by time, then by place in the file
    waiting = [(min(entries)[0], place, -1, -1, b"") for place, entries in wanted.items()]
    heapq.heapify(waiting)
    held_bytes = unpacked_bytes = 0
    while waiting:
        time_ns, place, offset, id, data = heapq.heappop(waiting)
        if offset >= 0:
            held_bytes -= len(data)
            yield time_ns, id, data
            continue
        chunk = _read_chunk(reader, place)
        if (unpacked_bytes := unpacked_bytes + len(chunk.getbuffer())) > max_unpacked:
            raise DataError(
                f"{reader.path}: its chunks unpack to more than {max_unpacked / MB:,.0f} MB, hundreds of "
                "times its size; if it is meant so, unpack it first: rosbag decompress"
            )
        for time_ns, offset, id in wanted.pop(place):
            data = _message_data(chunk, offset, id, time_ns)
            if (held_bytes := held_bytes + len(data)) > MAX_HELD_BYTES:
                raise ValueError("too many of its chunks overlap in time")
            heapq.heappush(waiting, (time_ns, place, offset, id, data))


def _check_places(chunks: Iterable[Any]) -> None:
    """Raise ValueError unless reading all chunks reads each byte of the file at most once."""
    end = 0
    for chunk in sorted(chunks, key=lambda chunk: int(chunk.datapos)):
        if chunk.datapos < end:
            raise ValueError("its index points to one chunk twice")
        end = chunk.datapos + chunk.datasize


def _read_chunk(reader: Any, place: int) -> BytesIO:
    """Return an unpacked chunk. Raises ValueError if it is too large."""
    from rosbags.rosbag1.reader import read_bytes

    chunk = reader.chunks[place]
    _check_size(chunk.datasize)
    reader.bio.seek(chunk.datapos)
    return BytesIO(_bounded(chunk.decompressor)(read_bytes(reader.bio, chunk.datasize)))


def _message_data(chunk: BinaryIO, offset: int, id: int, time_ns: int) -> bytes:
    """Return the data of the message record at `offset`, or after the connection records there. Raises
    ValueError if it is not the one that the index says."""
    from rosbags.rosbag1.reader import RecordType, read_bytes, read_uint32

    chunk.seek(offset)
    for _ in range(_MAX_SKIPPED):
        header = _record_header(chunk)
        if header.get_uint8("op") != RecordType.CONNECTION:
            break
        chunk.seek(read_uint32(chunk), SEEK_CUR)
    is_message = header.get_uint8("op") == RecordType.MSGDATA
    if not is_message or (header.get_uint32("conn"), header.get_time("time")) != (id, time_ns):
        raise ValueError("its index points to another message")
    return bytes(read_bytes(chunk, read_uint32(chunk)))


def _record_header(chunk: BinaryIO) -> Any:
    """Return the header of the record here. Raises ValueError if it is too large."""
    from rosbags.rosbag1.reader import Header, read_uint32

    if (size := read_uint32(chunk)) > _MAX_HEADER_BYTES:
        raise ValueError(f"the header of a record has {size} bytes")
    chunk.seek(-4, SEEK_CUR)
    return Header.read(chunk)


def _bounded(decompressor: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Return a decompressor that gives at most MAX_CHUNK_BYTES. Raises ValueError beyond."""
    import lz4.frame  # type: ignore[import-untyped]
    from rosbags.rosbag1.reader import Compression, decompressors

    makers: dict[Any, Callable[[], Any]] = {
        decompressors[Compression.BZ2.value]: bz2.BZ2Decompressor,
        decompressors[Compression.LZ4.value]: lz4.frame.LZ4FrameDecompressor,
    }
    if decompressor not in makers:
        return decompressor
    return partial(_unpack, makers[decompressor])


def _unpack(make: Callable[[], Any], data: bytes) -> bytes:
    unpacked = make().decompress(data, max_length=MAX_CHUNK_BYTES + 1)
    _check_size(len(unpacked))
    return bytes(unpacked)


def _check_size(chunk_bytes: int) -> None:
    if chunk_bytes > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk has more than {MAX_CHUNK_BYTES / MB:g} MB")


def _conversion_errors() -> tuple[type[Exception], ...]:
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError

    return (SerdeError, TypesysError, struct.error, ValueError, KeyError, IndexError, EOFError, OverflowError,
            RuntimeError, MemoryError, TypeError)  # fmt: skip
