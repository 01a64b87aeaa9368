"""Images and views of keyframes, read from the map file one by one when they are needed."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

from share.files.sqlite_file import limit_untrusted
from share.mapping.loops import KeyframeKey
from share.store import database, rows
from share.store.rows import COLUMNS, Row, is_intact
from share.types import U8
from share.vision.packed_view import PackedView

_MAX_ROW_BYTES = 4 * 1024**2


class KeyframeArchive:
    """Reads a map file that another process writes. What is missing or damaged is None."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._db: sqlite3.Connection | None = None
        self._file_id: tuple[int, int] | None = None  # of the open file: a repair replaces it

    def jpeg(self, key: KeyframeKey) -> U8 | None:
        """The JPEG (B,) of a keyframe."""
        row = self._row("image", key)
        return None if row is None else _decoded(rows.read_image, row)

    def view(self, key: KeyframeKey) -> PackedView | None:
        """The ORB features of a keyframe's image."""
        row = self._row("view", key)
        return None if row is None else _decoded(rows.read_view, row)

    def has_jpeg(self, key: KeyframeKey) -> bool:
        return bool(self._query("SELECT 1 FROM image WHERE run = ? AND id = ?", key))

    def has_view(self, key: KeyframeKey) -> bool:
        return bool(self._query("SELECT 1 FROM view WHERE run = ? AND id = ?", key))

    def _row(self, table: str, key: KeyframeKey) -> Row | None:
        columns = f"number, {', '.join(COLUMNS[table])}, crc"
        found = self._query(f"SELECT {columns} FROM {table} WHERE run = ? AND id = ?", key)
        if not found or not is_intact(table, found[0], found[1:]):
            return None
        return found[1:-1]

    def _query(self, query: str, key: KeyframeKey) -> tuple[Any, ...]:
        """The first row; () without one, and where the file cannot be read."""
        try:
            status = self._path.stat()
            file_id = status.st_dev, status.st_ino
            if self._db is None or file_id != self._file_id:
                self._db = None  # if opening fails, it is tried again
                self._file_id, self._db = file_id, database.open_for_reading(self._path)
                self._db.set_progress_handler(None, 0)  # each query reads one row
                limit_untrusted(self._db, _MAX_ROW_BYTES)
            return self._db.execute(query, key).fetchone() or ()
        except (*database.DAMAGE_ERRORS, OSError):
            return ()


def _decoded(read: Any, row: Row) -> Any:
    try:
        return read(row)[1]
    except (ValueError, TypeError):  # a correct CRC, and yet no value; msgspec's errors are ValueErrors
        return None
