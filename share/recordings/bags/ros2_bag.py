"""A ROS 2 bag: its folder with metadata.yaml, of one file or several, and its SQLite file (`.db3`).

The SQLite file is not trusted: plain tables, bounded rows, nothing that it computes.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from share.errors import ConfigError, DataError, UsageError
from share.files.reading import MB, path_inside, read_errors
from share.files.sqlite_file import UntrustedDatabase
from share.files.yaml_file import read_yaml
from share.recordings.bags import METADATA
from share.recordings.losses import DataLosses
from share.recordings.message_file import MessageFile, Messages, Topic
from share.types import I64

_TOP_KEY = "rosbag2_bagfile_information"
_SUFFIXES = {"mcap": ".mcap", "sqlite3": ".db3"}  # by storage_identifier
_MAX_FILES = 1000
_COLUMNS = {
    "topics": ("id", "name", "type", "serialization_format"),
    "messages": ("id", "topic_id", "timestamp", "data"),
}
_MAX_TOPICS, _MAX_NAME_LENGTH = 10_000, 500
_MAX_MESSAGE_BYTES = 64 * MB
_SDK_PREFIX = "/device_0/"  # of topics in recordings of the RealSense SDK, which are SQLite too


class BagMetadata(NamedTuple):
    """The content of metadata.yaml. files: of the bag, in order."""

    storage: str
    compression: str
    files: list[Path]


def bag_metadata(folder: Path) -> BagMetadata | None:
    """Return what a folder's metadata.yaml says; None if it is no ROS 2 bag's. Raises DataError, UsageError
    for a bag that is not read."""
    path = folder / METADATA
    if not path.is_file():
        return None
    try:
        top = read_yaml(path)
        if _TOP_KEY not in top:
            return None
        info = top.section(_TOP_KEY)
        storage, compression = info.text("storage_identifier"), info.text("compression_format", "")
        names = info.get("relative_file_paths")
    except ConfigError as error:
        raise DataError(str(error)) from None
    if storage not in _SUFFIXES:
        raise UsageError(f"{path}: storage '{storage:.40}' is not read; known: {', '.join(_SUFFIXES)}")
    if compression:
        raise UsageError(
            f"{folder}: is compressed ({compression:.40}); convert it with "
            "`ros2 bag convert`, or record without --compression-mode (MCAP compresses by itself)"
        )
    if not isinstance(names, list) or not 0 < len(names) <= _MAX_FILES:
        raise DataError(f"{path}: relative_file_paths: expected 1 to {_MAX_FILES} names of files")
    return BagMetadata(storage, compression, [_bag_file(folder, str(name), storage) for name in names])


def _bag_file(folder: Path, name: str, storage: str) -> Path:
    """Return a bag's file; up to ROS 2 Foxy its name begins with that of the folder. Raises DataError."""
    where = str(folder / METADATA)
    path = path_inside(folder, name, where)
    if not path.is_file():
        path = path_inside(folder, Path(name).name, where)
    if path.suffix != _SUFFIXES[storage] or not path.is_file():
        raise DataError(f"{where}: {name:.200} is missing; copy the bag again")
    return path


class SplitBag(MessageFile):
    """The messages of several files, which follow each other in time."""

    def __init__(self, path: Path, files: Sequence[MessageFile]) -> None:
        super().__init__(path)
        self._files = sorted(files, key=_first_ns)

    @cached_property
    def topics(self) -> Mapping[str, Topic]:
        """Topics by name. Raises DataError if files differ on a topic's type."""
        out: dict[str, Topic] = {}
        for file in self._files:
            for name, topic in file.topics.items():
                first = out.setdefault(name, topic)
                if first.kind != topic.kind:
                    raise DataError(
                        f"{self.path}: {name} is {first.kind} in one file, {topic.kind} in another"
                    )
        return out

    def metadata(self, name: str) -> dict[str, str]:
        return next((found for file in self._files if (found := file.metadata(name))), {})

    def _times(self, topic: Topic) -> list[I64]:
        return [file.log_times[topic.name] for file in self._files if topic.name in file.log_times]

    def _read(self, topics: list[str], start_ns: int, end_ns: int, losses: DataLosses | None) -> Messages:
        for file in self._files:
            yield from file.messages(topics, start_ns, end_ns, losses)


def _first_ns(file: MessageFile) -> int:
    return min((int(times[0]) for times in file.log_times.values() if len(times)), default=0)


def is_sqlite_bag(path: Path) -> bool:
    """Return whether a `.db3` file is rosbag2's, and not a recording of the RealSense SDK, or damaged."""
    if path.suffix != ".db3":
        return False
    try:
        topics = SqliteBag(path).topics
    except DataError:
        return False
    return bool(topics) and not any(name.startswith(_SDK_PREFIX) for name in topics)


class SqliteBag(MessageFile):
    """A file of a ROS 2 bag. Raises DataError if it is none."""

    @cached_property
    def topics(self) -> Mapping[str, Topic]:
        """Topics in CDR by name."""
        query = (
            "SELECT id, name, type FROM topics NOT INDEXED WHERE serialization_format = 'cdr' "
            "AND typeof(name) = 'text' AND typeof(type) = 'text' "
            f"AND length(name) <= {_MAX_NAME_LENGTH} AND length(type) <= {_MAX_NAME_LENGTH} "
            f"LIMIT {_MAX_TOPICS}"
        )
        out: dict[str, Topic] = {}
        for number, name, kind in self._rows(query):
            known = out.get(name)
            out[name] = Topic(name, kind, (*(known.channels if known else ()), number))
        return out

    @cached_property
    def _channel_times(self) -> dict[int, I64]:
        out: dict[int, list[int]] = {}
        query = "SELECT topic_id, timestamp FROM messages NOT INDEXED WHERE typeof(timestamp) = 'integer'"
        for number, stamp_ns in self._rows(query):
            out.setdefault(number, []).append(stamp_ns)
        return {number: np.array(times, np.int64) for number, times in out.items()}

    def _times(self, topic: Topic) -> list[I64]:
        return [self._channel_times[id] for id in topic.channels if id in self._channel_times]

    def _read(self, topics: list[str], start_ns: int, end_ns: int, losses: DataLosses | None) -> Messages:
        """In the order of recording."""
        channels = self.channels(topics)
        query = (
            f"SELECT id, topic_id, timestamp, CASE WHEN typeof(data) = 'blob' AND "
            f"length(data) <= {_MAX_MESSAGE_BYTES} THEN data END FROM messages NOT INDEXED "
            f"WHERE topic_id IN ({', '.join('?' * len(channels))}) AND typeof(timestamp) = 'integer' "
            "AND timestamp >= ? AND timestamp < ? ORDER BY id"
        )
        for row, number, stamp_ns, data in self._rows(query, *channels, start_ns, end_ns):
            if data is not None:
                yield channels[number], stamp_ns, data
                continue
            reason = f"{self.path}: message {row}: its data is missing or too large"
            if losses is None:
                raise DataError(reason)
            losses.add(f"messages of {channels[number]}", str(row), reason)

    def _rows(self, query: str, *values: int) -> Iterator[tuple[Any, ...]]:
        with read_errors(self.path):
            try:
                with closing(UntrustedDatabase(self.path, _COLUMNS, 4 * _MAX_MESSAGE_BYTES)) as file:
                    yield from file.rows(query, *values)
            except (sqlite3.Error, MemoryError, OverflowError, UnicodeError) as error:
                raise DataError(f"{self.path}: is not a file of a ROS 2 bag, or damaged: {error}") from None
