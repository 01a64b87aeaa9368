"""The edge's map on disk: an SQLite file with a write-ahead log and a single writer
(docs/lookup/map-file.md)."""

from __future__ import annotations

import contextlib
import math
import os
import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from share.errors import ShareError, StoreError, UsageError
from share.files.sqlite_file import wal_path
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import MapChange, StoredMap, Wipe
from share.store import database, rows, schema
from share.store.changes import add_forgotten, apply_change, first_row
from share.store.database import DamageError, is_map, why_not_written
from share.store.loading import (
    UNCOUNTED,
    OpenedMap,
    damage_text,
    decode_map,
    open_writer,
    outline_map,
    read_and_repair,
    read_only,
)
from share.store.salvage import ReadRows, finish_salvage, read_intact_rows, salvage, set_aside

__all__ = ["MapStore", "is_map", "oldest_arrival_s"]


class MapStore:
    """A map file, opened by `MapStore.open` or `MapStore.read`. Not thread-safe.

    writable: `write` can be called. read_only_reason: why not. problems: what was missing when it was opened,
    a line each.
    """

    loss = None  # a machine that is gone takes this process with it

    def __init__(self, path: Path, opened: OpenedMap, reason: str) -> None:
        self.path, self.read_only_reason, self.problems = path, reason, opened.problems
        self._opened: ReadRows | None = opened.rows  # None: outdated
        self._outline: StoredMap | None = None  # of `_opened`
        self._db: sqlite3.Connection | None = None
        self._is_closed = False  # `_db`, since a repair has failed: opened anew when it is needed
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
        database.refuse_hard_links(path)
        lock = database.lock_map(path)
        try:
            store = MapStore(path, read_and_repair(path), "")
            store._lock, store._durable = lock, durable
            store._start_writing()
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
        self._try_and_repair(partial(self._write, new_changes))

    def _write(self, new_changes: Sequence[MapChange]) -> None:
        db = self._writable_db()
        self._check_in_place()
        self._opened = self._outline = None
        try:
            db.execute("BEGIN IMMEDIATE")
            for change in new_changes:
                apply_change(db, change, time.time())
            db.execute("COMMIT")
        except BaseException as error:
            with contextlib.suppress(sqlite3.Error):  # on a full disk SQLite has rolled back by itself
                db.execute("ROLLBACK")
            if isinstance(error, sqlite3.Error | MemoryError):
                raise self._write_error(error) from None
            raise
        self._is_wiping |= any(isinstance(change, Wipe) for change in new_changes)
        if self._is_wiping:
            self._is_wiping = not self._empty_log()
        self._check_in_place()

    def compact(self) -> None:
        """Rewrite the file without what was removed, and empty its log; a damaged one is repaired first.

        Raises StoreError if the disk is full or fails, or another program reads the file: then all of the map
        is still there.
        """
        self._try_and_repair(self._compact)

    def _compact(self) -> None:
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
        try:
            is_busy, _, _ = first_row(self._writable_db(), "PRAGMA wal_checkpoint(TRUNCATE)")
        except sqlite3.Error as error:
            raise self._write_error(error) from None
        return not is_busy

    def _write_error(self, error: sqlite3.Error | MemoryError) -> StoreError:
        kind = DamageError if database.is_damage(error) else StoreError
        return kind(f"{self.path}: the map cannot be written: {why_not_written(error, self.path)}")

    def _try_and_repair(self, work: Callable[[], None]) -> None:
        """Do the work; where the file turns out to be damaged, repair it and do the work again."""
        try:
            work()
        except DamageError:
            self._repair()
            work()

    def _repair(self) -> None:
        """Salvage the file. Not all of it is read when it is opened, so it may be damaged unnoticed. Raises
        StoreError if the disk is full or fails; may be repeated."""
        self._close_db()
        with self._repairing():
            salvaged, renamed = salvage(self.path)
        self._note_file()
        self.problems = (*self.problems, damage_text(renamed), *decode_map(salvaged).problems)
        self._start_writing()

    @contextlib.contextmanager
    def _repairing(self) -> Iterator[None]:
        try:
            yield
        except ShareError as error:
            raise StoreError(f"{self.path}: the file is damaged and cannot be repaired: {error}") from None

    def _close_db(self) -> None:
        """Close the writer's connection, until `_start_writing` or `_open_again`. Its log may go with it."""
        assert self._db is not None
        self._db.close()
        self._is_closed = True
        self._file_ids.pop(wal_path(self.path), None)
        self._opened = self._outline = None

    def _note_file(self) -> None:
        """Note that the file is another one now."""
        self._file_ids = _read_file_ids(self.path)
        self._file_ids.pop(wal_path(self.path), None)

    def _open_again(self) -> None:
        """Open the writer's connection after a repair that has failed, perhaps in its last steps."""
        with self._repairing():
            renamed = finish_salvage(self.path)
        if renamed == self.path:
            self._check_in_place()
        else:
            self._note_file()
            self.problems = (*self.problems, damage_text(renamed), UNCOUNTED)
        self._start_writing()

    def _start_writing(self) -> None:
        """Open the writer's connection; what that has changed is not in the rows that were read before."""
        database.create_private(self.path)
        self._db = open_writer(self.path, self._durable, time.time())
        if self._db.total_changes:
            self._opened = self._outline = None
        self._file_ids, self._is_closed = _read_file_ids(self.path), False

    def image_bytes(self, keys: Iterable[KeyframeKey]) -> int:
        """Return how many bytes the JPEGs of these keyframes have, as far as the file can be read."""
        size, count = "SELECT ifnull(sum(length(jpeg)), 0) FROM image WHERE run = ? AND id = ?", 0
        for key in keys:
            with contextlib.suppress(*database.DAMAGE_ERRORS):
                count += int(first_row(self._writable_db(), size, *key)[0])
        return count

    def outline(self) -> StoredMap:
        """Return what runs continue from (`outline_map`). Raises StoreError."""
        if self._opened is None:
            return outline_map(self.rows())
        self._outline = self._outline or outline_map(self._opened)
        return self._outline

    def load(self) -> StoredMap:
        """Return the whole map, but images and views (`KeyframeArchive`). Raises StoreError."""
        loaded = decode_map(self.rows().copy())
        return replace(loaded, problems=self.problems or loaded.problems)

    def rows(self) -> ReadRows:
        """Return all rows but images and views: as `open` read them, or read again after a change. A file
        that turns out to be damaged is repaired first, as by `open`. Raises StoreError."""
        if self._opened is not None:
            return self._opened
        if self._db is None:
            return read_only(self.path).rows
        with contextlib.suppress(DamageError):
            if not (read_rows := self._read_rows(schema.SMALL_TABLES)).is_damaged:
                return read_rows
        self._check_in_place()
        self._repair()
        return self._read_rows(schema.SMALL_TABLES)

    def _read_rows(self, tables: Iterable[str]) -> ReadRows:
        with database.translate_errors(self.path, "read"):
            return read_intact_rows(self._writable_db(), tables)

    def set_aside(self, forgotten: Mapping[str, int]) -> Path:
        """Rename the map and start an empty one in its place, which knows the removed runs too. Return the
        new name of the old one. forgotten: removed runs that are known, as in `StoredMap`: the old one may be
        damaged.

        Raises ShareError if that fails: then the map is unchanged, or the new one knows none.
        """
        about = self._read_rows(["about"]).tables["about"]
        self._close_db()
        renamed = set_aside(self.path)
        self._file_ids = {}
        self._start_writing()
        with database.translate_errors(self.path, "written", writes=True), self._writable_db() as db:
            db.execute("BEGIN IMMEDIATE")
            add_forgotten(db, {**rows.read_forgotten_runs(about)[0], **forgotten})
        return renamed

    def close(self) -> None:
        """Checkpoint the log and unlock the file."""
        db, lock, self._db, self._lock = self._db, self._lock, None, None
        try:
            if db is not None:
                db.close()
        finally:
            if lock is not None:
                os.close(lock)

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
        if self._is_closed:
            self._open_again()
        return self._db


def _read_file_ids(path: Path) -> dict[Path, tuple[int, int]]:
    """Return device and inode of the map and its log, as far as they exist."""
    out = {}
    for file in (path, wal_path(path)):
        with contextlib.suppress(FileNotFoundError):
            status = file.stat()
            out[file] = status.st_dev, status.st_ino
    return out


def oldest_arrival_s(path: Path) -> float:
    """Return when the oldest keyframe in a map file arrived, unix s; infinity if it has none. Raises
    StoreError."""
    with database.translate_errors(path, "read"), contextlib.closing(database.open_for_reading(path)) as db:
        (oldest_s,) = first_row(db, "SELECT min(unix_s) FROM arrival")
    return math.inf if oldest_s is None else float(oldest_s)
