"""Recover MCAP recordings that were cut off: copy every intact message to a new file.

A file that was not closed has no index, and its last chunk may be incomplete. It is read from the start,
record by record, as far as possible.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, BinaryIO, NamedTuple

from share.errors import DataError, UsageError
from share.files.reading import open_regular
from share.files.writing import new_file
from share.recordings.mcap.chunks import BoundedFile, chunk_records
from share.recordings.mcap.file import check_magic, damage_errors


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

    writer = Writer(target, chunk_size=256 * 1024)
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
