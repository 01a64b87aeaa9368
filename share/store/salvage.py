"""A damaged map file: what is whole of it goes into a fresh one, and it is kept beside as FILE.damaged-1.

The fresh file is made first, under the name FILE.salvaged; then the damaged one with its log gives its
name up. A break in between leaves FILE.salvaged, and the next opening goes on from there.
"""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from share.files.reading import open_regular
from share.files.sqlite_file import log_of
from share.files.writing import fresh, sync_folder, writing
from share.store import connect, rows, schema
from share.store.connect import BROKEN
from share.store.rows import COLUMNS, Row, insert, is_whole
from share.store.schema import PAGE_BYTES, own_tables

# What hangs on rows that are lost. A keyframe that its agent still has may come again under its number.
_ORPHANS = (
    "DELETE FROM keyframe WHERE run NOT IN (SELECT key FROM run)",
    "DELETE FROM link WHERE (run, id) NOT IN (SELECT run, id FROM keyframe)",
    "DELETE FROM loop WHERE (a_run, a_id) NOT IN (SELECT run, id FROM keyframe)"
    " OR (b_run, b_id) NOT IN (SELECT run, id FROM keyframe)",
)

# Stretches whose own row is lost.
_NAMELESS = (
    "SELECT DISTINCT run, stretch FROM keyframe"
    " WHERE (run, stretch) NOT IN (SELECT run, nth FROM stretch) ORDER BY number"
)


@contextlib.contextmanager
def copied(path: Path, folder: Path | None = None) -> Iterator[Path]:
    """A copy of `path` and its log for the time of the block, below `folder` or where temporary files are."""
    with tempfile.TemporaryDirectory(prefix=".map.", dir=folder) as name:
        copy = Path(name) / path.name
        with writing(Path(name)):
            for old, new in ((path, copy), (log_of(path), log_of(copy))):
                if old == path or old.exists():
                    with open_regular(old) as source, fresh(new) as sink:
                        shutil.copyfileobj(source, sink)
        yield copy


def whole_of(path: Path, folder: Path | None = None) -> Found:
    """What is whole of a damaged file, read from a copy; with a first page of our own, if that finds more.

    The first page says where tables begin. It is the same in all maps, but for counters.
    """
    with copied(path, folder) as copy:
        as_it_is = _found(copy)
        log_of(copy).unlink(missing_ok=True)
        with writing(copy), copy.open("r+b") as file:
            file.write(schema.first_page())
        return max(as_it_is, _found(copy), key=Found.size)


def salvage(path: Path) -> tuple[Found, Path]:
    """Replace `path` by what is whole of it. Also answers the damaged file's new name. Raises ShareError."""
    found = with_copies(whole_of(path, path.parent))
    part = path.with_name(path.name + ".salvaged.part")
    part.unlink(missing_ok=True)
    with connect.complaints(part, "written"), writing(part):
        _write(found, part)
        part.replace(_finished(path))
    return found, finish(path)


def finish(path: Path) -> Path:
    """The last steps, each of which may be done already; `path` itself if there is nothing to finish."""
    if not _finished(path).exists():
        return path
    with writing(path):
        kept = set_aside(path)
        _finished(path).replace(path)
    sync_folder(path.parent)
    return kept


def set_aside(path: Path) -> Path:
    """A map that nobody has open, and its log, get another name, which is answered. Raises ShareError."""
    kept = _free_name(path)
    with writing(path):
        for old, new in ((log_of(path), log_of(kept)), (path, kept)):
            if old.exists():
                old.replace(new)
        path.with_name(path.name + "-shm").unlink(missing_ok=True)
    return kept


def _finished(path: Path) -> Path:
    return path.with_name(path.name + ".salvaged")


def _free_name(path: Path) -> Path:
    number = 1
    while (name := path.with_name(f"{path.name}.damaged-{number}")).exists():
        number += 1
    return name


def _found(copy: Path) -> Found:
    bare = sqlite3.connect(copy, isolation_level=None)
    with contextlib.closing(connect.for_so_long(bare, copy)) as connection:
        with contextlib.suppress(*BROKEN):  # moves the log into the file, as far as that is whole
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        return whole_rows(connection)


def _write(found: Found, part: Path) -> None:
    with contextlib.closing(sqlite3.connect(part, isolation_level=None)) as connection:
        connection.execute(f"PRAGMA page_size = {schema.PAGE_BYTES}")
        connection.execute("BEGIN")
        schema.create(connection)
        for table, numbered in found.tables.items():
            for number, row in numbered:
                if table != "about":
                    insert(connection, table, row, number)
        own = {run for _, (run, *_) in found.tables["run"]}
        for run, voice in rows.voices(found.tables["about"]).items():
            if run in own:
                insert(connection, "about", rows.of_voice(run, voice))
        for statement in _ORPHANS:
            connection.execute(statement)
        for stretch in connection.execute(_NAMELESS).fetchall():
            insert(connection, "stretch", stretch)
        connection.execute("COMMIT")


# ---- All rows of a map file that are whole; what is not is counted, never guessed.

PROBES = 100_000  # numbers looked up one by one between two parts of a damaged table, and no more than
_ROW_BYTES = 32  # rows of so many bytes that the file has room for


@dataclass
class Found:
    """Whole rows by table, with their numbers; how many others there are; and tables where nobody knows."""

    tables: dict[str, list[tuple[int, Row]]] = field(default_factory=dict)
    lost: Counter[str] = field(default_factory=Counter)
    uncounted: set[str] = field(default_factory=set)

    def size(self) -> int:
        return sum(map(len, self.tables.values()))

    @property
    def damaged(self) -> bool:
        return any(self.lost.values()) or bool(self.uncounted)


def whole_rows(connection: sqlite3.Connection) -> Found:
    """Every row of every table of our making that can be read and whose CRC is right."""
    found, own = Found(), _own(connection)
    for table in COLUMNS:
        everything, all_read = _everything(connection, table) if table in own else ({}, False)
        good = {n: row for n, row in everything.items() if is_whole(table, n, row)}
        found.tables[table] = [(n, row[:-1]) for n, row in sorted(good.items())]
        count = _count(connection, table) if table in own else None
        found.lost[table] = max(count or 0, len(everything)) - len(good)
        if count is None and not all_read:
            found.uncounted.add(table)
    return found


def with_copies(found: Found) -> Found:
    """Runs that can be read in only one of their two tables, in both."""
    first, second = (dict(found.tables[table]) for table in ("run", "run_copy"))
    both = sorted((second | first).items())
    there = max(len(first) + found.lost["run"], len(second) + found.lost["run_copy"])
    lost = found.lost.copy()
    lost["run"], lost["run_copy"] = there - len(both), 0
    one = {"run", "run_copy"} <= found.uncounted
    uncounted = found.uncounted - {"run_copy"} - (set() if one else {"run"})
    return Found(found.tables | {"run": both, "run_copy": both}, lost, uncounted)


def _own(connection: sqlite3.Connection) -> set[str]:
    try:
        return own_tables(connection)
    except BROKEN:
        return set()


def _everything(connection: sqlite3.Connection, table: str) -> tuple[dict[int, Row], bool]:
    """Rows by number, and whether that is all. From the front; where that breaks, from the back; and in
    between number by number."""
    select = f"SELECT number, {', '.join(COLUMNS[table])}, crc FROM {table} NOT INDEXED"
    rows: dict[int, Row] = {}
    if not _read(connection, f"{select} LIMIT 0", (), rows):
        return rows, False  # not even the table is known
    if _read(connection, f"{select} ORDER BY number", (), rows):
        return rows, True
    low = next(reversed(rows), 0)
    _read(connection, f"{select} WHERE number > ? ORDER BY number DESC", (low,), rows)
    high = next(reversed(rows), 0)
    probes = min(PROBES, _room(connection))
    for number in range(low + 1, min(high if high > low else low + probes, low + probes)):
        _read(connection, f"{select} WHERE number = ?", (number,), rows)
    return rows, False


def _room(connection: sqlite3.Connection) -> int:
    """For how many rows a file has room."""
    try:
        (pages,) = connection.execute("PRAGMA page_count").fetchone()
    except BROKEN:
        return PROBES
    return int(pages) * PAGE_BYTES // _ROW_BYTES


def _read(connection: sqlite3.Connection, query: str, values: tuple[int, ...], rows: dict[int, Row]) -> bool:
    """Into `rows`, up to where it breaks; whether it came to the end."""
    try:
        for number, *row in connection.execute(query, values):
            rows[number] = tuple(row)
    except BROKEN:
        return False
    return True


def _count(connection: sqlite3.Connection, table: str) -> int | None:
    """As an index has it, which is another part of the file; None where that cannot be read either."""
    try:
        return int(connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0])
    except BROKEN:
        return None
