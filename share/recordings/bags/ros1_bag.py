"""Read an untrusted ROS 1 bag (`.bag`, format 2.0) by rosbags, its messages converted to ROS 2's CDR.

rosbags unpacks chunks whatever they grow to and reads as much as a length says: here both are bounded.
"""

from __future__ import annotations

import bz2
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import DataError
from share.files.reading import open_regular, read_errors
from share.recordings.losses import DataLosses
from share.recordings.mcap import ros_messages as ros
from share.recordings.mcap.file import MAX_CHUNK_BYTES, BoundedFile
from share.recordings.message_file import MessageFile, Messages, Topic
from share.types import I64


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
        with self._opened() as reader:
            chosen = [one for one in reader.connections if one.id in channels]
            for connection, stamp_ns, data in reader.messages(chosen, start_ns, end_ns):
                try:
                    cdr = bytes(ros.typestore().ros1_to_cdr(data, connection.msgtype))
                except _conversion_errors() as error:
                    reason = f"{self.path}: {connection.topic} at {stamp_ns}: cannot be read ({error})"
                    if losses is None:
                        raise DataError(reason) from None
                    losses.add(f"messages of {connection.topic}", str(stamp_ns), reason)
                else:
                    yield connection.topic, stamp_ns, cdr

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        """Yield rosbags' reader of this file. Errors in the block that damage can cause become DataError."""
        from rosbags.rosbag1 import Reader, ReaderError

        with read_errors(self.path):
            try:
                reader = Reader(_RegularFile(self.path))
                reader.open()
                with closing(reader):
                    for place, chunk in reader.chunks.items():
                        reader.chunks[place] = chunk._replace(decompressor=_bounded(chunk.decompressor))
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
    if len(unpacked) > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk unpacks to more than {MAX_CHUNK_BYTES} bytes")
    return bytes(unpacked)


def _conversion_errors() -> tuple[type[Exception], ...]:
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError

    return (SerdeError, TypesysError, struct.error, ValueError, KeyError, IndexError, EOFError, OverflowError,
            RuntimeError, MemoryError, TypeError)  # fmt: skip
