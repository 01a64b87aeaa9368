"""All rows of a map file that are whole; what is not is counted, never guessed."""

from __future__ import annotations

import sqlite3
from collections import Counter
from dataclasses import dataclass, field

from share.io.map_store.connect import BROKEN
from share.io.map_store.rows import COLUMNS, Row, is_whole
from share.io.map_store.schema import PAGE_BYTES, own_tables

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
