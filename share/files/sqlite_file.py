"""SQLite files from anywhere, for reading: nothing in them is run, rows and searches are bounded."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote

from share.files.reading import is_hollow, open_regular

_EVERY = 10_000  # of SQLite's steps, between two counts of them: some 0.1 ms
_STEPS, _STEPS_A_BYTE = (
    10**8,
    100,
)  # before a row is given: seconds, and more where there is more to look through
_CACHE_KB = 8000


def distrust(connection: sqlite3.Connection, most_bytes: int) -> None:
    """Before anything is read. most_bytes: of a row, and so of a blob. Raises sqlite3.Error."""
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, most_bytes)


def log_of(path: Path) -> Path:
    """Where SQLite keeps what is committed, but not yet in the file."""
    return path.with_name(path.name + "-wal")


def index_of(path: Path) -> Path:
    """What SQLite looks up in that log, shared between processes."""
    return path.with_name(path.name + "-shm")


def read_only(path: Path) -> str:
    """Its URI. Without a log nobody writes, and no file beside it is needed."""
    mode = "mode=ro" if log_of(path).exists() else "immutable=1"
    return f"file:{quote(str(path.resolve()))}?{mode}"


class Untrusted:
    """Tables of one file; columns: those that each must have, by table. Raises OSError for what is no regular
    file, sqlite3.Error for what is no database of such tables: each a plain one, whose first column is the
    number of its rows and no column of which is computed."""

    def __init__(self, path: Path, columns: Mapping[str, tuple[str, ...]], most_bytes: int) -> None:
        for file in (path, log_of(path)):
            if file == path or file.is_symlink() or file.exists():
                open_regular(file).close()
                if is_hollow(file):
                    raise sqlite3.DatabaseError("it is nearly all holes")
        self._connection = sqlite3.connect(read_only(path), uri=True, isolation_level=None)
        self._most = _STEPS + _STEPS_A_BYTE * path.stat().st_size
        self._steps = 0
        try:
            distrust(self._connection, most_bytes)
            self._connection.execute(f"PRAGMA cache_size = -{_CACHE_KB}")
            self._connection.set_progress_handler(self._step, _EVERY)
            for table, names in columns.items():
                self._check(table, names)
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
        self._steps += _EVERY
        return self._steps > self._most

    def _check(self, table: str, names: tuple[str, ...]) -> None:
        kinds = self.rows(f"SELECT type, sql FROM sqlite_schema WHERE name = '{table}'").fetchall()
        if [(kind, str(sql).upper().split()[:2]) for kind, sql in kinds] != [("table", ["CREATE", "TABLE"])]:
            raise sqlite3.DatabaseError(f"no table {table} as it should be")
        found = self.rows(f"PRAGMA table_xinfo({table})").fetchall()
        if any(hidden for *_, hidden in found):
            raise sqlite3.DatabaseError(f"a column of {table} is computed")
        if missing := [name for name in names if name not in {column[1] for column in found}]:
            raise sqlite3.DatabaseError(f"table {table} has no {missing[0]}")
        numbered = [(name, str(kind).upper()) for _, name, kind, _, _, key, _ in found if key]
        if numbered != [(names[0], "INTEGER")]:
            raise sqlite3.DatabaseError(f"rows of {table} are not numbered by {names[0]}")
