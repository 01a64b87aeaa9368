"""The edge's map on disk: an SQLite file with a write-ahead log and a single writer
(docs/lookup/map-file.md)."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from share.errors import StoreError, UsageError
from share.files.sqlite_file import wal_path
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import (
    MapChange,
    RemoveKeyframes,
    RemoveLoops,
    RemoveRun,
    SaveCredential,
    SaveKeyframe,
    SaveLink,
    SaveLoop,
    SavePoses,
    SaveRun,
    SaveView,
    StoredMap,
    Wipe,
)
from share.store import database, rows, schema
from share.store.database import DamageError, is_map, why_not_written
from share.store.loading import (
    OpenedMap,
    damage_text,
    decode_map,
    open_writer,
    outline_map,
    read_and_repair,
    read_only,
)
from share.store.rows import COLUMNS, insert
from share.store.salvage import ReadRows, read_intact_rows, salvage, set_aside

__all__ = ["MapStore", "is_map"]


class MapStore:
    """A map file, opened by `MapStore.open` or `MapStore.read`. Not thread-safe.

    writable: `write` can be called. read_only_reason: why not. problems: what was missing when it was opened,
    a line each.
    """

    def __init__(self, path: Path, opened: OpenedMap, reason: str) -> None:
        self.path, self.read_only_reason, self.problems = path, reason, opened.problems
        self._opened: ReadRows | None = opened.rows  # None: outdated
        self._db: sqlite3.Connection | None = None
        self._file_ids: dict[Path, tuple[int, int]] = {}  # device and inode of the map's files
        self._lock: int | None = None
        self._durable = False
        self._is_wiping = False  # the log still has what a `Wipe` demands to be gone

    @property
    def writable(self) -> bool:
        return self._db is not None

    @property
    def schema(self) -> int | None:
        """The file's schema number; None if it cannot be read."""
        try:
            with contextlib.closing(database.open_for_reading(self.path)) as connection:
                return schema.read_version(connection)
        except database.DAMAGE_ERRORS:
            return None

    @staticmethod
    def open(path: Path, durable: bool = False) -> MapStore:
        """Open the map at `path`, or create it; all of it but images and views is read and checked. Only its
        owner may read it.

        Of a damaged file all intact rows are taken over, and it is kept as FILE.damaged-N. One of an older
        schema is converted. One that may not be written is opened for reading. durable: commits wait for the
        disk, so that a power failure loses none. Raises UsageError if it is no map, or of another schema;
        StoreError if another edge uses it; ShareError if the disk is full or fails. The file is then
        unchanged.
        """
        path = path.resolve() if path.is_symlink() else path
        if path.is_dir():
            raise UsageError(f"{path}: is a folder; give the name of a file")
        reason = database.write_obstacle(path)
        if reason and not path.exists():
            raise UsageError(f"{path}: a map cannot be made there: {reason}")
        if reason:
            return MapStore.read(path, reason)
        lock = database.lock_map(path)
        try:
            store = MapStore(path, read_and_repair(path), "")
            database.create_private(path)
            store._db, store._lock = open_writer(path, durable, time.time()), lock
            store._file_ids, store._durable = _read_file_ids(path), durable
            return store
        except BaseException:
            os.close(lock)
            raise

    @staticmethod
    def read(path: Path, reason: str = "it was opened for reading") -> MapStore:
        """Open a map for reading; an edge may use it at the same time. Raises UsageError, ShareError."""
        return MapStore(path, read_only(path), reason)

    def write(self, new_changes: Sequence[MapChange]) -> None:
        """Write all changes or none. After the return they survive any end of this process.

        A file that turns out to be damaged is repaired first, as by `open`. Raises StoreError if the disk is
        full or fails: then none is written, and the call may be repeated.
        """
        try:
            self._write(new_changes)
        except DamageError:
            self._repair()
            self._write(new_changes)

    def _write(self, new_changes: Sequence[MapChange]) -> None:
        db = self._writable_db()
        self._check_in_place()
        self._opened = None
        try:
            db.execute("BEGIN IMMEDIATE")
            for change in new_changes:
                apply_change(db, change, time.time())
            db.execute("COMMIT")
        except BaseException as error:
            with contextlib.suppress(sqlite3.Error):  # on a full disk SQLite has rolled back by itself
                db.execute("ROLLBACK")
            if isinstance(error, sqlite3.Error):
                raise self._write_error(error) from None
            raise
        self._is_wiping |= any(isinstance(change, Wipe) for change in new_changes)
        if self._is_wiping:
            self._is_wiping = not self._empty_log()
        self._check_in_place()

    def _repair(self) -> None:
        """Salvage the file. Not all of it is read when it is opened, so it may be damaged unnoticed."""
        self._writable_db().close()
        try:
            renamed = salvage(self.path)[1]
            self.problems = (*self.problems, damage_text(renamed))
        finally:
            self._opened = None
            database.create_private(self.path)
            self._db = open_writer(self.path, self._durable, time.time())
            self._file_ids = _read_file_ids(self.path)

    def compact(self) -> None:
        """Rewrite the file without what was removed, and empty its log. Raises StoreError if the disk is full
        or fails, or another program reads the file: then all of the map is still there."""
        db = self._writable_db()
        self._check_in_place()
        try:
            db.execute("VACUUM")
        except sqlite3.Error as error:
            raise self._write_error(error) from None
        if not self._empty_log():
            raise StoreError(f"{self.path}: another program reads the map; end it and repeat the command")

    def _empty_log(self) -> bool:
        """Write the log back to the file and cut it to nothing. Return whether no reader prevented it."""
        is_busy, _, _ = _first_row(self._writable_db(), "PRAGMA wal_checkpoint(TRUNCATE)")
        return not is_busy

    def _write_error(self, error: sqlite3.Error) -> StoreError:
        kind = DamageError if database.is_damage(error) else StoreError
        return kind(f"{self.path}: the map cannot be written: {why_not_written(error, self.path)}")

    def outline(self) -> StoredMap:
        """Return what runs continue from (`outline_map`). Raises StoreError."""
        return outline_map(self.rows())

    def load(self) -> StoredMap:
        """Return the whole map, but images and views of schema 5 (`KeyframeArchive`). Raises StoreError."""
        loaded = decode_map(self.rows().copy())
        return replace(loaded, problems=self.problems or loaded.problems)

    def rows(self) -> ReadRows:
        """Return all rows but images and views: as `open` read them, or read again after a `write`. Raises
        StoreError."""
        if self._opened is not None:
            return self._opened
        if self._db is None:
            return read_only(self.path).rows
        return read_intact_rows(self._db, [t for t in COLUMNS if t not in schema.LARGE_TABLES])

    def set_aside(self) -> Path:
        """Rename the map and start an empty one in its place. Return the new name of the old one.

        Raises ShareError if that fails: then the map is unchanged.
        """
        self._writable_db().close()
        try:
            return set_aside(self.path)
        finally:
            self._opened = None
            database.create_private(self.path)
            self._db = open_writer(self.path, self._durable, time.time())
            self._file_ids = _read_file_ids(self.path)

    def close(self) -> None:
        """Checkpoint the log and unlock the file."""
        if self._db is not None:
            self._db.close()
            self._db = None
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def abandon(self) -> None:
        """Give up the file without closing it, while another thread hangs in `write`. The lock ends with the
        process."""
        self._db = self._lock = None

    def __enter__(self) -> MapStore:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _check_in_place(self) -> None:
        """Raises StoreError if a file was removed or replaced: SQLite would go on writing to the unlinked
        one."""
        now = _read_file_ids(self.path)
        for path, file_id in self._file_ids.items():
            if now.get(path) != file_id:
                what = "removed" if path not in now else "replaced"
                raise StoreError(
                    f"{self.path}: the map cannot be written: {path.name} was {what} while the edge ran; "
                    "put it back, or restart the edge"
                )

    def _writable_db(self) -> sqlite3.Connection:
        if self._db is None:
            raise StoreError(
                f"{self.path}: the map cannot be written: {self.read_only_reason or 'it was closed'}"
            )
        return self._db


def _read_file_ids(path: Path) -> dict[Path, tuple[int, int]]:
    """Return device and inode of the map and its log, as far as they exist."""
    out = {}
    for file in (path, wal_path(path)):
        with contextlib.suppress(FileNotFoundError):
            status = file.stat()
            out[file] = status.st_dev, status.st_ino
    return out


# ---- Changes as SQL, within the caller's transaction

_RUN_COLUMNS = (
    *(("run", "key"), ("run_copy", "key"), ("stretch", "run"), ("keyframe", "run"), ("link", "run")),
    *(("loop", "a_run"), ("loop", "b_run"), ("arrival", "run"), ("image", "run"), ("view", "run")),
)


def apply_change(db: sqlite3.Connection, change: MapChange, now_s: float) -> None:
    """Apply one change; again it changes nothing. now_s: unix s. Raises ValueError for a keyframe of an
    unknown run."""
    match change:
        case SaveRun():
            _insert_run(db, change)
        case SaveCredential(run, credential):
            _set_credential(db, run, credential)
        case SaveKeyframe():
            _insert_keyframe(db, change, now_s)
        case SaveLink():
            _delete_row(db, "link", change.key)
            insert(db, "link", rows.link_row(change))
        case SaveView():
            _insert_view(db, change)
        case SaveLoop():
            _insert_loop(db, change)
        case RemoveLoops(a, b):
            for first, second in ((a, b), (b, a)):
                db.execute(
                    "DELETE FROM loop WHERE a_run = ? AND a_id = ? AND b_run = ? AND b_id = ?",
                    (*first, *second),
                )
        case RemoveKeyframes():
            for key in change.keys:
                _remove_keyframe(db, key)
        case RemoveRun():
            _delete_run(db, change.run_key)
        case SavePoses():
            db.execute("DELETE FROM poses")
            insert(db, "poses", rows.poses_row(change))


def _insert_run(db: sqlite3.Connection, change: SaveRun) -> None:
    if not _first_row(db, "SELECT 1 FROM run WHERE key = ?", change.run_key):
        for table in ("run", "run_copy"):
            insert(db, table, rows.run_row(change, 0))
        _set_credential(db, change.run_key, change.credential)


def _set_credential(db: sqlite3.Connection, run: str, credential: str | None) -> None:
    row = rows.credential_row(run, credential or "")
    db.execute("DELETE FROM about WHERE name = ?", row[:1])
    if credential and _first_row(db, "SELECT 1 FROM run WHERE key = ?", run):
        insert(db, "about", row)


def _insert_keyframe(db: sqlite3.Connection, change: SaveKeyframe, now_s: float) -> None:
    if change.keyframe_key.id < _next_id(db, change.run_key):
        return
    segment, ordinal = _segment_and_ordinal(db, change.run_key, starts_segment=change.keyframe.reference < 0)
    insert(db, "keyframe", rows.keyframe_row(change, segment, ordinal))
    insert(db, "arrival", rows.arrival_row(change.keyframe_key, now_s))
    if len(jpeg := change.keyframe.image.jpeg):
        insert(db, "image", rows.image_row(change.keyframe_key, jpeg))


def _insert_view(db: sqlite3.Connection, change: SaveView) -> None:
    _delete_row(db, "view", change.key)
    if _first_row(db, "SELECT 1 FROM keyframe WHERE run = ? AND id = ?", *change.key):
        insert(db, "view", rows.view_row(change))


def _segment_and_ordinal(db: sqlite3.Connection, run: str, starts_segment: bool) -> tuple[int, int]:
    """Return the number of the run's newest segment, or of a new one, and the keyframe's position in it."""
    (segment,) = _first_row(db, "SELECT ifnull(max(nth), -1) FROM stretch WHERE run = ?", run)
    if starts_segment or segment < 0:
        insert(db, "stretch", (run, segment + 1))
        return segment + 1, 0
    newest = "SELECT stretch, ordinal FROM keyframe WHERE run = ? ORDER BY id DESC LIMIT 1"
    previous_segment, ordinal = _first_row(db, newest, run) or (-1, -1)
    return segment, ordinal + 1 if previous_segment == segment else 0


def _next_id(db: sqlite3.Connection, run: str) -> int:
    """Return one more than the largest keyframe id that the run ever had."""
    row = _first_row(db, "SELECT next FROM run WHERE key = ?", run)
    if not row:
        raise ValueError(f"run {run} is not in the file; its SaveRun must come first")
    (next_id,) = _first_row(db, "SELECT ifnull(max(id) + 1, 0) FROM keyframe WHERE run = ?", run)
    return max(int(row[0]), int(next_id))


def _insert_loop(db: sqlite3.Connection, change: SaveLoop) -> None:
    row = rows.loop_row(change.loop)
    same = " AND ".join(f"{name} IS ?" for name in COLUMNS["loop"])
    if not _first_row(db, f"SELECT 1 FROM loop WHERE {same}", *row):
        insert(db, "loop", row)


def _remove_keyframe(db: sqlite3.Connection, key: KeyframeKey) -> None:
    next_id = _next_id(db, key.agent)
    for table in ("keyframe", "link", "arrival", "image", "view"):
        _delete_row(db, table, key)
    db.execute("DELETE FROM loop WHERE a_run = ? AND a_id = ?", key)
    db.execute("DELETE FROM loop WHERE b_run = ? AND b_id = ?", key)
    if _next_id(db, key.agent) < next_id:  # it was the newest: the remaining rows do not show its id
        _store_next_id(db, key.agent, next_id)


def _delete_run(db: sqlite3.Connection, run: str) -> None:
    for table, column in _RUN_COLUMNS:
        db.execute(f"DELETE FROM {table} WHERE {column} = ?", (run,))
    _set_credential(db, run, None)


def _store_next_id(db: sqlite3.Connection, run: str, next_id: int) -> None:
    for table in ("run", "run_copy"):
        number, codec, hello = _first_row(db, f"SELECT number, codec, hello FROM {table} WHERE key = ?", run)
        db.execute(f"DELETE FROM {table} WHERE number = ?", (number,))
        insert(db, table, (run, next_id, codec, hello), number)


def _delete_row(db: sqlite3.Connection, table: str, key: KeyframeKey) -> None:
    db.execute(f"DELETE FROM {table} WHERE run = ? AND id = ?", key)


def _first_row(db: sqlite3.Connection, query: str, *values: Any) -> tuple[Any, ...]:
    """Return the first row, or ()."""
    return db.execute(query, values).fetchone() or ()
