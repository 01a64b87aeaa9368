"""Salvage of a damaged map file: its intact rows go to a new file, and it is kept as FILE.damaged-1.

The new file is made first, as FILE.salvaged; then the damaged one and its log are renamed. If that is
interrupted, FILE.salvaged remains, and the next opening finishes the work.
"""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from share.files.reading import open_regular
from share.files.sqlite_file import wal_path
from share.files.writing import open_new, sync_folder, write_errors
from share.store import database, rows, schema
from share.store.conversion import move_images
from share.store.database import DAMAGE_ERRORS, check_damage
from share.store.rows import COLUMNS, Row, insert, is_intact
from share.store.schema import PAGE_BYTES, own_tables

# Rows that depend on lost ones. An agent that still has a lost keyframe may send it again under its id.
_DELETE_ORPHANS = (
    "DELETE FROM keyframe WHERE run NOT IN (SELECT key FROM run)",
    "DELETE FROM link WHERE (run, id) NOT IN (SELECT run, id FROM keyframe)",
    "DELETE FROM arrival WHERE (run, id) NOT IN (SELECT run, id FROM keyframe)",
    "DELETE FROM image WHERE (run, id) NOT IN (SELECT run, id FROM keyframe)",
    "DELETE FROM view WHERE (run, id) NOT IN (SELECT run, id FROM keyframe)",
    "DELETE FROM loop WHERE (a_run, a_id) NOT IN (SELECT run, id FROM keyframe)"
    " OR (b_run, b_id) NOT IN (SELECT run, id FROM keyframe)",
)

# Segments without a row, because it is lost.
_SEGMENTS_WITHOUT_ROW = (
    "SELECT DISTINCT run, stretch FROM keyframe"
    " WHERE (run, stretch) NOT IN (SELECT run, nth FROM stretch) ORDER BY number"
)


@contextlib.contextmanager
def temporary_copy(path: Path, folder: Path | None = None) -> Iterator[Path]:
    """Copy `path` and its log to `folder`, or the default for temporary files, for the time of the block."""
    with tempfile.TemporaryDirectory(prefix=".map.", dir=folder) as name:
        copy = Path(name) / path.name
        with write_errors(Path(name)):
            for old, new in ((path, copy), (wal_path(path), wal_path(copy))):
                if old == path or old.exists():
                    with open_regular(old) as source, open_new(new) as sink:
                        shutil.copyfileobj(source, sink)
        yield copy


def read_damaged(path: Path, folder: Path | None = None) -> ReadRows:
    """Read the intact rows of a damaged file, from a copy, as it is or with a new first page, whichever
    yields most. Raises ShareError if the disk is full or fails, or memory is short.

    The first page locates the tables. It is the same in all maps of a schema, except for counters.
    """
    with temporary_copy(path, folder) as copy, database.translate_errors(path, "read"):
        best = _read_copy(copy)
        wal_path(copy).unlink(missing_ok=True)
        for version in (schema.SCHEMA, schema.OLDEST_SCHEMA):
            with write_errors(copy), copy.open("r+b") as file:
                file.write(schema.first_page(version))
            best = max(best, _read_copy(copy), key=ReadRows.row_count)
        return best


def salvage(path: Path) -> tuple[ReadRows, Path]:
    """Replace `path` by a file of its intact rows. Return these and the damaged file's new name. Raises
    ShareError."""
    read_rows = merge_run_copies(read_damaged(path, path.parent))
    part = path.with_name(path.name + ".salvaged.part")
    part.unlink(missing_ok=True)
    database.create_private(part)
    with database.translate_errors(part, "written", writes=True), write_errors(part):
        _write_rows(read_rows, part)
        part.replace(_salvaged_path(path))
    return read_rows, finish_salvage(path)


def finish_salvage(path: Path) -> Path:
    """Do the last steps of a salvage, of which some may be done. Return the damaged file's new name, or
    `path` if there was nothing to do."""
    if not _salvaged_path(path).exists():
        return path
    with write_errors(path):
        renamed = set_aside(path)
        _salvaged_path(path).replace(path)
    sync_folder(path.parent)
    return renamed


def set_aside(path: Path) -> Path:
    """Rename a map that is not open, and its log. Return the new name. Raises ShareError."""
    renamed = _free_name(path)
    database.make_private(path)
    with write_errors(path):
        for old, new in ((wal_path(path), wal_path(renamed)), (path, renamed)):
            if old.exists():
                old.replace(new)
        path.with_name(path.name + "-shm").unlink(missing_ok=True)
    return renamed


def _salvaged_path(path: Path) -> Path:
    return path.with_name(path.name + ".salvaged")


def _free_name(path: Path) -> Path:
    number = 1
    while (name := path.with_name(f"{path.name}.damaged-{number}")).exists():
        number += 1
    return name


def _read_copy(copy: Path) -> ReadRows:
    bare = sqlite3.connect(copy, isolation_level=None)
    with contextlib.closing(database.limit_time(bare, copy)) as connection:
        with contextlib.suppress(*DAMAGE_ERRORS):  # applies the intact part of the log
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        return read_intact_rows(connection)


def _write_rows(read_rows: ReadRows, part: Path) -> None:
    with contextlib.closing(sqlite3.connect(part, isolation_level=None)) as connection:
        connection.execute(f"PRAGMA page_size = {schema.PAGE_BYTES}")
        connection.execute("BEGIN")
        schema.create(connection)
        for table, numbered in read_rows.tables.items():
            for number, row in numbered:
                if table != "about":
                    insert(connection, table, row, number)
        known_runs = {run for _, (run, *_) in read_rows.tables["run"]}
        for run, credential in rows.read_credentials(read_rows.tables["about"]).items():
            if run in known_runs:
                insert(connection, "about", rows.credential_row(run, credential))
        for stored in rows.read_objects(read_rows.tables["about"])[0]:
            insert(connection, "about", rows.object_row(stored))
        for forgotten in rows.read_forgotten_runs(read_rows.tables["about"])[0].items():
            insert(connection, "about", rows.forgotten_row(*forgotten))
        for statement in _DELETE_ORPHANS:
            connection.execute(statement)
        if not read_rows.tables["image"]:  # the file may be of an older schema
            move_images(connection)
        for segment in connection.execute(_SEGMENTS_WITHOUT_ROW).fetchall():
            insert(connection, "stretch", segment)
        connection.execute("COMMIT")


# ---- Reading intact rows

MAX_PROBES = 100_000  # row numbers looked up one by one in the gap of a damaged table
_MIN_ROW_BYTES = 32  # smallest row, which bounds the number of rows by the file size


@dataclass
class ReadRows:
    """Intact rows by table, with their numbers; counts of lost rows; tables with uncountable losses."""

    tables: dict[str, list[tuple[int, Row]]] = field(default_factory=dict)
    lost_counts: Counter[str] = field(default_factory=Counter)
    uncounted: set[str] = field(default_factory=set)

    @staticmethod
    def empty() -> ReadRows:
        """The rows of a new file."""
        return ReadRows({table: [] for table in COLUMNS})

    def copy(self) -> ReadRows:
        """Return the same rows in other lists."""
        tables = {table: list(numbered) for table, numbered in self.tables.items()}
        return ReadRows(tables, self.lost_counts.copy(), set(self.uncounted))

    def row_count(self) -> int:
        return sum(map(len, self.tables.values()))

    @property
    def is_damaged(self) -> bool:
        return any(self.lost_counts.values()) or bool(self.uncounted)


def read_intact_rows(connection: sqlite3.Connection, tables: Iterable[str] = tuple(COLUMNS)) -> ReadRows:
    """Read all rows of our own tables that are readable and have a correct CRC; count the others. Raises what
    SQLite does where the machine fails."""
    read_rows, own = ReadRows(), _own_tables(connection)
    for table in tables:
        if table in schema.ADDED_TABLES and table not in own:  # the file is of an older schema
            read_rows.tables[table] = []
            continue
        table_rows, all_read = _read_table(connection, table) if table in own else ({}, False)
        intact = {n: row for n, row in table_rows.items() if is_intact(table, n, row)}
        read_rows.tables[table] = [(n, row[:-1]) for n, row in sorted(intact.items())]
        count = _count_rows(connection, table) if table in own else None
        read_rows.lost_counts[table] = max(count or 0, len(table_rows)) - len(intact)
        if count is None and not all_read:
            read_rows.uncounted.add(table)
    return read_rows


def merge_run_copies(read_rows: ReadRows) -> ReadRows:
    """Return the rows with each run in both of its tables, if it is readable in one."""
    first, second = (dict(read_rows.tables[table]) for table in ("run", "run_copy"))
    both = sorted((second | first).items())
    run_count = max(
        len(first) + read_rows.lost_counts["run"], len(second) + read_rows.lost_counts["run_copy"]
    )
    lost_counts = read_rows.lost_counts.copy()
    lost_counts["run"], lost_counts["run_copy"] = run_count - len(both), 0
    one_uncounted = {"run", "run_copy"} <= read_rows.uncounted
    uncounted = read_rows.uncounted - {"run_copy"} - (set() if one_uncounted else {"run"})
    return ReadRows(read_rows.tables | {"run": both, "run_copy": both}, lost_counts, uncounted)


def _own_tables(connection: sqlite3.Connection) -> set[str]:
    try:
        return own_tables(connection)
    except DAMAGE_ERRORS as error:
        check_damage(error)
        return set()


def _read_table(connection: sqlite3.Connection, table: str) -> tuple[dict[int, Row], bool]:
    """Return a table's rows by number, and whether these are all: read from the front, on an error from the
    back, and the gap number by number."""
    select = f"SELECT number, {', '.join(COLUMNS[table])}, crc FROM {table} NOT INDEXED"
    rows: dict[int, Row] = {}
    if not _read_query(connection, f"{select} LIMIT 0", (), rows):
        return rows, False  # the table itself is unreadable
    if _read_query(connection, f"{select} ORDER BY number", (), rows):
        return rows, True
    low = next(reversed(rows), 0)
    _read_query(connection, f"{select} WHERE number > ? ORDER BY number DESC", (low,), rows)
    high = next(reversed(rows), 0)
    probes = min(MAX_PROBES, _max_row_count(connection))
    for number in range(low + 1, min(high if high > low else low + probes, low + probes)):
        _read_query(connection, f"{select} WHERE number = ?", (number,), rows)
    return rows, False


def _max_row_count(connection: sqlite3.Connection) -> int:
    """Return how many rows the file has room for."""
    try:
        (pages,) = connection.execute("PRAGMA page_count").fetchone()
    except DAMAGE_ERRORS as error:
        check_damage(error)
        return MAX_PROBES
    return int(pages) * PAGE_BYTES // _MIN_ROW_BYTES


def _read_query(
    connection: sqlite3.Connection, query: str, values: tuple[int, ...], rows: dict[int, Row]
) -> bool:
    """Read rows into `rows` up to the first error. Return whether there was none."""
    try:
        for number, *row in connection.execute(query, values):
            rows[number] = tuple(row)
    except DAMAGE_ERRORS as error:
        check_damage(error)
        return False
    return True


def _count_rows(connection: sqlite3.Connection, table: str) -> int | None:
    """Return the number of rows by an index, another part of the file; None if that is unreadable too."""
    try:
        return int(connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0])
    except DAMAGE_ERRORS as error:
        check_damage(error)
        return None
