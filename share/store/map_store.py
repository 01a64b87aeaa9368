"""The edge's map on disk: an SQLite file with a write-ahead log and a single writer
(docs/lookup/map-file.md)."""

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

__all__ = ["MapStore", "is_map"]


class MapStore:
    """A map file, opened by `MapStore.open` or `MapStore.read`. Not thread-safe.

    writable: `write` can be called. read_only_reason: why not. schema: of the file when it was opened.
    """

    def __init__(self, path: Path, loaded_map: StoredMap, schema: int, reason: str) -> None:
        self.path, self.schema, self.read_only_reason = path, schema, reason
        self._loaded_map: StoredMap | None = loaded_map
        self._db: sqlite3.Connection | None = None
        self._file_ids: dict[Path, tuple[int, int]] = {}  # device and inode of the map's files
        self._lock: int | None = None
        self._durable = False

    @property
    def writable(self) -> bool:
        return self._db is not None

    @staticmethod
    def open(path: Path, durable: bool = False) -> MapStore:
        """Open the map at `path`, or create it; all of it is read and checked.

        A file of an older schema is copied to FILE.schema-N and migrated. Of a damaged file all intact rows
        are taken over, and it is kept as FILE.damaged-N. A file that may not be written is opened for
        reading. durable: commits wait for the disk, so that a power failure loses none. Raises UsageError if
        it is no map, or of a newer SHARE; StoreError if another edge uses it; ShareError if the disk is full
        or fails. The file is then unchanged.
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
        """Open a map for reading; an edge may use it at the same time. Raises UsageError, ShareError."""
        return MapStore(path, *load_read_only(path), reason)

    def write(self, new_changes: Sequence[MapChange]) -> None:
        """Write all changes or none. After the return they survive any end of this process.

        Raises StoreError if the disk is full or fails: then none is written, and the call may be repeated.
        """
        db = self._writable_db()
        self._check_in_place()
        self._loaded_map = None  # outdated
        try:
            db.execute("BEGIN IMMEDIATE")
            for change in new_changes:
                changes.apply_change(db, change)
            db.execute("COMMIT")
        except BaseException as error:
            with contextlib.suppress(sqlite3.Error):  # on a full disk SQLite has rolled back by itself
                db.execute("ROLLBACK")
            if isinstance(error, sqlite3.Error):
                why = why_not_written(error, self.path)
                raise StoreError(f"{self.path}: the map cannot be written: {why}") from None
            raise
        self._check_in_place()

    def opened_map(self) -> StoredMap:
        """Return the map as `open` read it; call before `write` and `load`."""
        return StoredMap() if self._loaded_map is None else self._loaded_map

    def load(self) -> StoredMap:
        """Return the whole map; the first call returns what `open` read. Raises StoreError."""
        loaded, self._loaded_map = self._loaded_map, None
        if loaded is not None:
            return loaded
        if self._db is None:
            return load_read_only(self.path)[0]
        return decoding.decode_map(read_intact_rows(self._db))

    def set_aside(self) -> Path:
        """Rename the map and start an empty one in its place. Return the new name of the old one.

        Raises ShareError if that fails: then the map is unchanged.
        """
        self._writable_db().close()
        try:
            return set_aside(self.path)
        finally:
            self._loaded_map = None
            self._db = open_writer(self.path, self._durable)
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
