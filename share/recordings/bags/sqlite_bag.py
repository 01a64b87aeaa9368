"""Read an untrusted SQLite file of rosbag2 (`.db3`): plain tables, bounded rows, nothing that it computes."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import DataError
from share.files.reading import MB, read_errors
from share.files.sqlite_file import UntrustedDatabase
from share.recordings.losses import DataLosses
from share.recordings.mcap.file import Topic
from share.types import I64

_COLUMNS = {
    "topics": ("id", "name", "type", "serialization_format"),
    "messages": ("id", "topic_id", "timestamp", "data"),
}
_MAX_TOPICS, _MAX_NAME_LENGTH = 10_000, 500
_MAX_MESSAGE_BYTES = 64 * MB
_SDK_PREFIX = "/device_0/"  # of topics in recordings of the RealSense SDK, which are SQLite too
_LIMIT_NS = 2**62


def is_sqlite_bag(path: Path) -> bool:
    """Return whether a `.db3` file is rosbag2's, and not a recording of the RealSense SDK, or damaged."""
    if path.suffix != ".db3":
        return False
    try:
        topics = SqliteBag(path).topics
    except DataError:
        return False
    return bool(topics) and not any(name.startswith(_SDK_PREFIX) for name in topics)


class SqliteBag:
    """A file of a ROS 2 bag; every pass opens it again. Raises DataError if it is none."""

    def __init__(self, path: Path) -> None:
        self.path = path

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
    def log_times(self) -> Mapping[str, I64]:
        by_id: dict[int, list[int]] = {}
        query = "SELECT topic_id, timestamp FROM messages NOT INDEXED WHERE typeof(timestamp) = 'integer'"
        for number, stamp_ns in self._rows(query):
            by_id.setdefault(number, []).append(stamp_ns)
        return {
            topic.name: np.sort(np.array([t for n in topic.channels for t in by_id.get(n, [])], np.int64))
            for topic in self.topics.values()
        }

    def metadata(self, name: str) -> dict[str, str]:
        return {}

    def messages(
        self,
        topics: Iterable[str],
        start_ns: int | None = None,
        end_ns: int | None = None,
        losses: DataLosses | None = None,
    ) -> Iterator[tuple[str, int, bytes]]:
        """As `MessageFile.messages`, in the order of recording."""
        names = {n: name for name in topics if name in self.topics for n in self.topics[name].channels}
        query = (
            f"SELECT id, topic_id, timestamp, CASE WHEN typeof(data) = 'blob' AND "
            f"length(data) <= {_MAX_MESSAGE_BYTES} THEN data END FROM messages NOT INDEXED "
            f"WHERE topic_id IN ({', '.join('?' * len(names))}) AND typeof(timestamp) = 'integer' "
            "AND timestamp >= ? AND timestamp < ? ORDER BY id"
        )
        limits = (-_LIMIT_NS if start_ns is None else start_ns, _LIMIT_NS if end_ns is None else end_ns)
        for row, number, stamp_ns, data in self._rows(query, *names, *limits):
            if data is not None:
                yield names[number], stamp_ns, data
                continue
            reason = f"{self.path}: message {row}: its data is missing or too large"
            if losses is None:
                raise DataError(reason)
            losses.add(f"messages of {names[number]}", str(row), reason)

    def _rows(self, query: str, *values: int) -> Iterator[tuple[Any, ...]]:
        with read_errors(self.path):
            try:
                with closing(UntrustedDatabase(self.path, _COLUMNS, 4 * _MAX_MESSAGE_BYTES)) as file:
                    yield from file.rows(query, *values)
            except (sqlite3.Error, MemoryError, OverflowError, UnicodeError) as error:
                raise DataError(f"{self.path}: is not a file of a ROS 2 bag, or damaged: {error}") from None
