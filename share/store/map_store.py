"""The edge's map on disk: one SQLite file with a log (WAL), and one writer. Read docs/map-file.md."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Sequence
from pathlib import Path

from share.errors import StoreError, UsageError
from share.files.sqlite_file import log_of
from share.mapping.changes import Change, Kept
from share.store import changes, connect, reading, schema
from share.store.connect import is_map, why_not_written
from share.store.opening import examine, look, make
from share.store.salvage import set_aside, whole_rows

# ---- The edge's map on disk.

__all__ = ["MapStore", "is_map"]


class MapStore:
    """Opened by `MapStore.open`. May be called from any one thread at a time.

    writable: whether `write` can be called. reason: why not. schema: of the file, as it was found.
    """

    def __init__(self, path: Path, kept: Kept, schema: int, reason: str) -> None:
        self.path, self.schema, self.reason = path, schema, reason
        self._kept: Kept | None = kept
        self._db: sqlite3.Connection | None = None
        self._files: dict[Path, tuple[int, int]] = {}  # those of the map, and which they are
        self._lock: int | None = None
        self._power_cut = False

    @property
    def writable(self) -> bool:
        return self._db is not None

    @staticmethod
    def open(path: Path, power_cut: bool = False) -> MapStore:
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
        reason = connect.obstacle(path)
        if reason and not path.exists():
            raise UsageError(f"{path}: a map cannot be made there: {reason}")
        if reason:
            return MapStore.read(path, reason)
        held = connect.take(path)
        try:
            store = MapStore(path, examine(path), schema.SCHEMA, "")
            store._db, store._lock = make(path, power_cut), held
            store._files, store._power_cut = _which(path), power_cut
            return store
        except BaseException:
            os.close(held)
            raise

    @staticmethod
    def read(path: Path, reason: str = "it was opened for reading") -> MapStore:
        """A map to read only, beside an edge in another process too. Raises UsageError, ShareError."""
        return MapStore(path, *look(path), reason)

    def write(self, news: Sequence[Change]) -> None:
        """All of them or none; on return they survive the end of this process, however it ends.

        Raises StoreError if the disk is full or fails: then none was kept, and it may be tried again.
        """
        db = self._writer()
        self._check_in_place()
        self._kept = None  # of before
        try:
            db.execute("BEGIN IMMEDIATE")
            for change in news:
                changes.apply(db, change)
            db.execute("COMMIT")
        except BaseException as error:
            with contextlib.suppress(sqlite3.Error):  # a full disk has rolled back by itself
                db.execute("ROLLBACK")
            if isinstance(error, sqlite3.Error):
                why = why_not_written(error, self.path)
                raise StoreError(f"{self.path}: the map cannot be written: {why}") from None
            raise
        self._check_in_place()

    def peek(self) -> Kept:
        """What `open` has read, before anything is written or loaded."""
        return Kept() if self._kept is None else self._kept

    def load(self) -> Kept:
        """All that is kept. The first time it is what `open` has read. Raises StoreError."""
        kept, self._kept = self._kept, None
        if kept is not None:
            return kept
        if self._db is None:
            return look(self.path)[0]
        return reading.kept(whole_rows(self._db))

    def set_aside(self) -> Path:
        """A fresh map in place of this one, which is kept beside; its new name.

        Raises ShareError where that cannot be: then the map is as it was.
        """
        self._writer().close()
        try:
            return set_aside(self.path)
        finally:
            self._kept = None
            self._db = make(self.path, self._power_cut)
            self._files = _which(self.path)

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
        now = _which(self.path)
        for path, which in self._files.items():
            if now.get(path) != which:
                what = "removed" if path not in now else "replaced"
                raise StoreError(
                    f"{self.path}: the map cannot be written: {path.name} was {what} while the edge ran; "
                    "put it back, or start the edge again"
                )

    def _writer(self) -> sqlite3.Connection:
        if self._db is None:
            raise StoreError(f"{self.path}: the map cannot be written: {self.reason or 'it was closed'}")
        return self._db


def _which(path: Path) -> dict[Path, tuple[int, int]]:
    """Device and inode of the map and its log, of those that are there."""
    out = {}
    for file in (path, log_of(path)):
        with contextlib.suppress(FileNotFoundError):
            found = file.stat()
            out[file] = found.st_dev, found.st_ino
    return out
