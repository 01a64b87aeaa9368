"""The edge's map on disk: one SQLite file with a log (WAL), and one writer. Read docs/lookup/map-file.md."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Sequence
from pathlib import Path

from share.errors import StoreError, UsageError
from share.files.sqlite_file import wal_path
from share.mapping.map_changes import MapChange, StoredMap
from share.store import changes, database, decoding, schema
from share.store.database import is_map, why_not_written
from share.store.opening import load_and_repair, load_read_only, open_writer
from share.store.salvage import read_intact_rows, set_aside

# ---- The edge's map on disk.

__all__ = ["MapStore", "is_map"]


class MapStore:
    """Opened by `MapStore.open`. May be called from any one thread at a time.

    writable: whether `write` can be called. reason: why not. schema: of the file, as it was found.
    """

    def __init__(self, path: Path, loaded_map: StoredMap, schema: int, reason: str) -> None:
        self.path, self.schema, self.read_only_reason = path, schema, reason
        self._loaded_map: StoredMap | None = loaded_map
        self._db: sqlite3.Connection | None = None
        self._file_ids: dict[Path, tuple[int, int]] = {}  # those of the map, and which they are
        self._lock: int | None = None
        self._durable = False

    @property
    def writable(self) -> bool:
        return self._db is not None

    @staticmethod
    def open(path: Path, durable: bool = False) -> MapStore:
        """The map in `path`, made if there is none; all of it is read and checked.

        An older schema is brought up to date after a copy, FILE.schema-N, was made. From a damaged file
        what is whole is taken over; it stays beside as FILE.damaged-N. A file that may not be written is
        opened for reading. power_cut: even that costs no commit, for the price of waiting for the disk.
        Raises UsageError if it is no map, or of a newer SHARE; StoreError if another edge has it; ShareError
        if the disk is full or fails. The file is then as it was.
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
            store = MapStore(path, load_and_repair(path), schema.SCHEMA, "")
            store._db, store._lock = open_writer(path, durable), lock
            store._file_ids, store._durable = _read_file_ids(path), durable
            return store
        except BaseException:
            os.close(lock)
            raise

    @staticmethod
    def read(path: Path, reason: str = "it was opened for reading") -> MapStore:
        """A map to read only, beside an edge in another process too. Raises UsageError, ShareError."""
        return MapStore(path, *load_read_only(path), reason)

    def write(self, new_changes: Sequence[MapChange]) -> None:
        """All of them or none; on return they survive the end of this process, however it ends.

        Raises StoreError if the disk is full or fails: then none was kept, and it may be tried again.
        """
        db = self._writable_db()
        self._check_in_place()
        self._loaded_map = None  # of before
        try:
            db.execute("BEGIN IMMEDIATE")
            for change in new_changes:
                changes.apply_change(db, change)
            db.execute("COMMIT")
        except BaseException as error:
            with contextlib.suppress(sqlite3.Error):  # a full disk has rolled back by itself
                db.execute("ROLLBACK")
            if isinstance(error, sqlite3.Error):
                why = why_not_written(error, self.path)
                raise StoreError(f"{self.path}: the map cannot be written: {why}") from None
            raise
        self._check_in_place()

    def opened_map(self) -> StoredMap:
        """What `open` has read, before anything is written or loaded."""
        return StoredMap() if self._loaded_map is None else self._loaded_map

    def load(self) -> StoredMap:
        """All that is kept. The first time it is what `open` has read. Raises StoreError."""
        loaded, self._loaded_map = self._loaded_map, None
        if loaded is not None:
            return loaded
        if self._db is None:
            return load_read_only(self.path)[0]
        return decoding.decode_map(read_intact_rows(self._db))

    def set_aside(self) -> Path:
        """A fresh map in place of this one, which is kept beside; its new name.

        Raises ShareError where that cannot be: then the map is as it was.
        """
        self._writable_db().close()
        try:
            return set_aside(self.path)
        finally:
            self._loaded_map = None
            self._db = open_writer(self.path, self._durable)
            self._file_ids = _read_file_ids(self.path)

    def close(self) -> None:
        """Moves the log into the file and gives it free."""
        if self._db is not None:
            self._db.close()
            self._db = None
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def abandon(self) -> None:
        """In place of `close`, while another thread waits in `write` for a disk that does not answer: nothing
        is asked of it any more. The lock ends with the process."""
        self._db = self._lock = None

    def __enter__(self) -> MapStore:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _check_in_place(self) -> None:
        """SQLite would go on writing to a file that has lost its name, and nobody would find it there."""
        now = _read_file_ids(self.path)
        for path, file_id in self._file_ids.items():
            if now.get(path) != file_id:
                what = "removed" if path not in now else "replaced"
                raise StoreError(
                    f"{self.path}: the map cannot be written: {path.name} was {what} while the edge ran; "
                    "put it back, or start the edge again"
                )

    def _writable_db(self) -> sqlite3.Connection:
        if self._db is None:
            raise StoreError(
                f"{self.path}: the map cannot be written: {self.read_only_reason or 'it was closed'}"
            )
        return self._db


def _read_file_ids(path: Path) -> dict[Path, tuple[int, int]]:
    """Device and inode of the map and its log, of those that are there."""
    out = {}
    for file in (path, wal_path(path)):
        with contextlib.suppress(FileNotFoundError):
            status = file.stat()
            out[file] = status.st_dev, status.st_ino
    return out
