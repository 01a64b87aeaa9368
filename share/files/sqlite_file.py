"""Read untrusted SQLite files: nothing in them is run; sizes of rows and costs of queries are bounded."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote

from share.files.reading import is_sparse, open_regular

STEPS_PER_CHECK = 10_000  # of SQLite's virtual machine, between two checks: some 0.1 ms
_MIN_STEPS = 10**8  # allowed per query, whatever the file's size: seconds
_STEPS_PER_BYTE = 100  # allowed more per byte of the file
_CACHE_KB = 8000


def limit_untrusted(connection: sqlite3.Connection, max_row_bytes: int) -> None:
    """Make a connection safe for an untrusted file; call before reading. Raises sqlite3.Error.

    max_row_bytes: limit of a row, and so of a blob.
    """
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max_row_bytes)


def wal_path(path: Path) -> Path:
    """Return the file of SQLite's write-ahead log: committed changes that are not yet in the database."""
    return path.with_name(path.name + "-wal")


def shm_path(path: Path) -> Path:
    """Return the file of the index of SQLite's write-ahead log, which processes share."""
    return path.with_name(path.name + "-shm")


def read_only_uri(path: Path) -> str:
    """Return the URI for reading a database. Without a log it has no writer, and needs no file beside it."""
    mode = "mode=ro" if wal_path(path).exists() else "immutable=1"
    return f"file:{quote(str(path.resolve()))}?{mode}"


class UntrustedDatabase:
    """A database file opened for reading. columns: the columns that each table must have.

    Raises OSError if it is not a regular file, sqlite3.Error if it is not a database with these tables. Each
    must be a plain table with the first column as its integer primary key and no computed column.
    """

    def __init__(self, path: Path, columns: Mapping[str, tuple[str, ...]], max_row_bytes: int) -> None:
        for file in (path, wal_path(path)):
            if file == path or file.is_symlink() or file.exists():
                open_regular(file).close()
                if is_sparse(file):
                    raise sqlite3.DatabaseError("it is nearly all holes (sparse)")
        self._connection = sqlite3.connect(read_only_uri(path), uri=True, isolation_level=None)
        self._max_steps = _MIN_STEPS + _STEPS_PER_BYTE * path.stat().st_size
        self._steps = 0
        try:
            limit_untrusted(self._connection, max_row_bytes)
            self._connection.execute(f"PRAGMA cache_size = -{_CACHE_KB}")
            self._connection.set_progress_handler(self._step, STEPS_PER_CHECK)
            for table, names in columns.items():
                self._check_table(table, names)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._connection.close()

    def rows(self, query: str, *values: int) -> sqlite3.Cursor:
        """Run a query. Raises sqlite3.Error, also while rows are read."""
        self._steps = 0
        return self._connection.execute(query, values)

    def _step(self) -> bool:
        self._steps += STEPS_PER_CHECK
        return self._steps > self._max_steps

    def _check_table(self, table: str, names: tuple[str, ...]) -> None:
        kinds = self.rows(f"SELECT type, sql FROM sqlite_schema WHERE name = '{table}'").fetchall()
        if [(kind, str(sql).upper().split()[:2]) for kind, sql in kinds] != [("table", ["CREATE", "TABLE"])]:
            raise sqlite3.DatabaseError(f"table {table} is missing, or not a plain table")
        columns = self.rows(f"PRAGMA table_xinfo({table})").fetchall()
        if any(hidden for *_, hidden in columns):
            raise sqlite3.DatabaseError(f"a column of {table} is computed")
        if missing := [name for name in names if name not in {column[1] for column in columns}]:
            raise sqlite3.DatabaseError(f"table {table} has no {missing[0]}")
        numbered = [(name, str(kind).upper()) for _, name, kind, _, _, key, _ in columns if key]
        if numbered != [(names[0], "INTEGER")]:
            raise sqlite3.DatabaseError(f"rows of {table} are not numbered by {names[0]}")
