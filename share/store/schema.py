"""The tables of a map file, and its schema number.

Every row ends in a CRC-32 of its table's name and its other columns, so each can be checked alone. The table
`about` is the same in all schemas: it holds the schema number. A newer schema only adds tables, so an older
file is converted by creating them (`share.store.conversion`).
"""

from __future__ import annotations

import sqlite3

from share import __version__
from share.store.rows import COLUMNS, insert, is_intact

SCHEMA = 5
OLDEST_SCHEMA = 3  # that can be converted: SHARE 0.1.0's; 1 and 2 were never released
PAGE_BYTES = 8192

TABLES = """
CREATE TABLE about(number INTEGER PRIMARY KEY, name TEXT UNIQUE, value TEXT, crc INTEGER);
CREATE TABLE run(number INTEGER PRIMARY KEY, key TEXT UNIQUE, next INTEGER, codec INTEGER, hello BLOB, crc INTEGER);
CREATE TABLE run_copy(number INTEGER PRIMARY KEY, key TEXT UNIQUE, next INTEGER, codec INTEGER, hello BLOB, crc INTEGER);
CREATE TABLE stretch(number INTEGER PRIMARY KEY, run TEXT, nth INTEGER, crc INTEGER, UNIQUE(run, nth));
CREATE TABLE keyframe(number INTEGER PRIMARY KEY, run TEXT, id INTEGER, stretch INTEGER, ordinal INTEGER,
    codec INTEGER, message BLOB, crc INTEGER, UNIQUE(run, id));
CREATE TABLE link(number INTEGER PRIMARY KEY, run TEXT, id INTEGER, reference INTEGER, T_ref_body BLOB, cov BLOB,
    crc INTEGER, UNIQUE(run, id));
CREATE TABLE loop(number INTEGER PRIMARY KEY, a_run TEXT, a_id INTEGER, b_run TEXT, b_id INTEGER, T_a_b BLOB,
    cov BLOB, inliers INTEGER, found REAL, crc INTEGER);
CREATE INDEX loop_a ON loop(a_run, a_id);
CREATE INDEX loop_b ON loop(b_run, b_id);
CREATE TABLE poses(number INTEGER PRIMARY KEY, keys BLOB, T_map_body BLOB, crc INTEGER)
"""  # noqa: E501
_ADDED = {  # by schema; last in the file, so that page 1 of an older file differs in nothing else
    5: "CREATE TABLE arrival(number INTEGER PRIMARY KEY, run TEXT, id INTEGER, unix_s INTEGER, crc INTEGER,"
    " UNIQUE(run, id));\n"
    "CREATE TABLE image(number INTEGER PRIMARY KEY, run TEXT, id INTEGER, jpeg BLOB, crc INTEGER,"
    " UNIQUE(run, id));\n"
    "CREATE TABLE view(number INTEGER PRIMARY KEY, run TEXT, id INTEGER, view BLOB, crc INTEGER,"
    " UNIQUE(run, id))",
}
ADDED_TABLES = ("arrival", "image", "view")  # which an older file lacks
LARGE_TABLES = ("image", "view")  # rows are read when needed, not when the file is opened
SMALL_TABLES = tuple(table for table in COLUMNS if table not in LARGE_TABLES)


def _statements(version: int) -> list[str]:
    added = [statement for number, statement in _ADDED.items() if number <= version]
    return ";\n".join([TABLES.strip(), *added]).split(";\n")


def create(connection: sqlite3.Connection, version: int = SCHEMA) -> None:
    """Create all tables, within an open transaction."""
    for statement in _statements(version):
        connection.execute(statement)
    for name, value in (("schema", str(version)), ("made by", f"SHARE {__version__}")):
        insert(connection, "about", (name, value))


def add_tables(connection: sqlite3.Connection) -> bool:
    """Add the tables that an intact file of an older schema lacks, and set its number, within an open
    transaction. Return whether it was one."""
    version = read_version(connection) or OLDEST_SCHEMA
    if version == SCHEMA:
        return False
    for statement in _statements(SCHEMA)[len(_statements(version)) :]:
        connection.execute(statement)
    (number,) = connection.execute("SELECT number FROM about WHERE name = 'schema'").fetchone()
    connection.execute("DELETE FROM about WHERE number = ?", (number,))
    insert(connection, "about", ("schema", str(SCHEMA)), number)
    return True


def read_version(connection: sqlite3.Connection) -> int | None:
    """Return the file's schema number; None if its row is not intact. Raises sqlite3.Error."""
    if "about" not in own_tables(connection):
        return None
    rows = connection.execute("SELECT number, name, value, crc FROM about NOT INDEXED").fetchall()
    intact = (row for number, *row in rows if is_intact("about", number, tuple(row)))
    return next(
        (int(value) for name, value, _ in intact if name == "schema" and str(value).isdecimal()), None
    )


def matches_schema(connection: sqlite3.Connection) -> bool:
    """Return whether tables and indexes are exactly those of the file's own schema."""
    version = read_version(connection)
    return version is not None and _objects(connection) == _objects(_template(version))


def own_tables(connection: sqlite3.Connection) -> set[str]:
    """Return the tables that are defined exactly like ours. Nothing else of a file is read: a view or virtual
    table may compute forever, a generated column may have any size. Raises sqlite3.Error."""
    return {name for kind, name, _, _ in _objects(connection) & _objects(_template()) if kind == "table"}


def is_empty(connection: sqlite3.Connection) -> bool:
    return not _objects(connection)


def first_page(version: int = SCHEMA) -> bytes:
    """Return page 1 of a file of this schema number: the header and the root page of each table.

    The number of pages (bytes 28 to 31) is 0: SQLite then uses the file's length.
    """
    page = bytearray(_template(version).serialize()[:PAGE_BYTES])
    page[28:32] = bytes(4)
    return bytes(page)


def _template(version: int = SCHEMA) -> sqlite3.Connection:
    connection = sqlite3.connect(":memory:", isolation_level=None)
    connection.execute(f"PRAGMA page_size = {PAGE_BYTES}")
    create(connection, version)
    return connection


def _objects(connection: sqlite3.Connection) -> set[tuple[str, ...]]:
    return set(connection.execute("SELECT type, name, tbl_name, sql FROM sqlite_schema"))
