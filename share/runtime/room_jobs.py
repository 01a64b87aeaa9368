"""What waits for processes and disk where a room falls asleep or wakes up: jobs of a thread, each with an
answer. None raises."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from pathlib import Path

from share.errors import StoreError, brief_reason
from share.runtime.room_parts import OpenedRoom, OpenRoom
from share.runtime.served_room import ServedRoom
from share.store.map_store import oldest_arrival_s

_MAX_CLOSE_S = 86_400.0  # for the disk, when a room falls asleep

FileStamp = tuple[int, int, int]


@dataclass(frozen=True)
class ProcessesEnded:
    """Of a room that falls asleep. error: with which that failed; None: it did not."""

    error: str | None


@dataclass(frozen=True)
class FileClosed:
    """oldest_s: when the oldest keyframe in the file arrived, unix s; infinity where all are kept. stamp: of
    the file as the room has left it."""

    incomplete_reason: str | None
    oldest_s: float
    stamp: FileStamp | None


@dataclass(frozen=True, eq=False)
class FileOpened:
    """is_unchanged: since the room fell asleep."""

    opened: OpenedRoom
    is_unchanged: bool


@dataclass(frozen=True)
class NotOpened:
    reason: str


RoomAnswer = ProcessesEnded | FileClosed | FileOpened | NotOpened


def end_processes(room: ServedRoom) -> ProcessesEnded:
    try:
        room.end_processes()
    except Exception as error:  # such as no thread to be had: its file is closed all the same
        return ProcessesEnded(brief_reason(error))
    return ProcessesEnded(None)


def close_file(room: ServedRoom, path: Path, expires: bool) -> FileClosed:
    """Close the map file, however long its disk takes: nobody waits for it, and a file that is given up stays
    locked. expires: keyframes that are too old are to be forgotten."""
    try:
        incomplete_reason = room.close_file(_MAX_CLOSE_S)
    except Exception as error:  # likewise
        incomplete_reason = brief_reason(error)
    try:
        oldest_s = oldest_arrival_s(path) if expires else math.inf
    except Exception:
        oldest_s = -math.inf  # said when the file is opened, which is due now
    return FileClosed(incomplete_reason, oldest_s, file_stamp(path))


def open_map(path: Path, closed_stamp: FileStamp | None, open_room: OpenRoom) -> FileOpened | NotOpened:
    stamp = file_stamp(path)
    try:
        if stamp is None:  # its folder may come back
            raise StoreError(f"{path}: is gone since its room fell asleep; put it back, or restart the edge")
        opened = open_room(path)
        store = opened.store
        if not store.writable:  # keyframes would be acknowledged that no file has
            store.close()
            raise StoreError(f"{path}: the map cannot be written: {store.read_only_reason}")
        with contextlib.suppress(Exception):  # said when the room starts, or the file is set aside then
            store.outline()  # which takes a while, and is kept
        return FileOpened(opened, stamp == closed_stamp)
    except Exception as error:  # such as a folder of another machine that is away
        return NotOpened(brief_reason(error))


def file_stamp(path: Path) -> FileStamp | None:
    """Return inode, size and time of the last change; None if there is no such file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns
