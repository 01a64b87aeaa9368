"""SQLite files from anywhere, for reading: nothing in them is run, rows and searches are bounded."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote

from share.files.reading import is_sparse, open_regular

_STEPS_PER_CHECK = 10_000  # of SQLite's steps, between two counts of them: some 0.1 ms
_MIN_STEPS, _STEPS_PER_BYTE = (
    10**8,
    100,
)  # before a row is given: seconds, and more where there is more to look through
_CACHE_KB = 8000


def limit_untrusted(connection: sqlite3.Connection, max_row_bytes: int) -> None:
    """Before anything is read. most_bytes: of a row, and so of a blob. Raises sqlite3.Error."""
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max_row_bytes)


def wal_path(path: Path) -> Path:
    """Where SQLite keeps what is committed, but not yet in the file."""
    return path.with_name(path.name + "-wal")


def shm_path(path: Path) -> Path:
    """What SQLite looks up in that log, shared between processes."""
    return path.with_name(path.name + "-shm")


def read_only_uri(path: Path) -> str:
    """Its URI. Without a log nobody writes, and no file beside it is needed."""
    mode = "mode=ro" if wal_path(path).exists() else "immutable=1"
    return f"file:{quote(str(path.resolve()))}?{mode}"


class UntrustedDatabase:
    """Tables of one file; columns: those that each must have, by table. Raises OSError for what is no regular
    file, sqlite3.Error for what is no database of such tables: each a plain one, whose first column is the
    number of its rows and no column of which is computed."""

    def __init__(self, path: Path, columns: Mapping[str, tuple[str, ...]], max_row_bytes: int) -> None:
        for file in (path, wal_path(path)):
            if file == path or file.is_symlink() or file.exists():
                open_regular(file).close()
                if is_sparse(file):
                    raise sqlite3.DatabaseError("it is nearly all holes")
        self._connection = sqlite3.connect(read_only_uri(path), uri=True, isolation_level=None)
        self._max_steps = _MIN_STEPS + _STEPS_PER_BYTE * path.stat().st_size
        self._steps = 0
        try:
            limit_untrusted(self._connection, max_row_bytes)
            self._connection.execute(f"PRAGMA cache_size = -{_CACHE_KB}")
            self._connection.set_progress_handler(self._step, _STEPS_PER_CHECK)
            for table, names in columns.items():
                self._check_table(table, names)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._connection.close()

    def rows(self, query: str, *values: int) -> sqlite3.Cursor:
        """Raises sqlite3.Error, also in the course of it."""
        self._steps = 0
        return self._connection.execute(query, values)

    def _step(self) -> bool:
        self._steps += _STEPS_PER_CHECK
        return self._steps > self._max_steps

    def _check_table(self, table: str, names: tuple[str, ...]) -> None:
        kinds = self.rows(f"SELECT type, sql FROM sqlite_schema WHERE name = '{table}'").fetchall()
        if [(kind, str(sql).upper().split()[:2]) for kind, sql in kinds] != [("table", ["CREATE", "TABLE"])]:
            raise sqlite3.DatabaseError(f"no table {table} as it should be")
        columns = self.rows(f"PRAGMA table_xinfo({table})").fetchall()
        if any(hidden for *_, hidden in columns):
            raise sqlite3.DatabaseError(f"a column of {table} is computed")
        if missing := [name for name in names if name not in {column[1] for column in columns}]:
            raise sqlite3.DatabaseError(f"table {table} has no {missing[0]}")
        numbered = [(name, str(kind).upper()) for _, name, kind, _, _, key, _ in columns if key]
        if numbered != [(names[0], "INTEGER")]:
            raise sqlite3.DatabaseError(f"rows of {table} are not numbered by {names[0]}")
