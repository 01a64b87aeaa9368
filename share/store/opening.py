"""What opening a map file takes: is it one, of which schema, is it whole?"""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

from share.errors import StoreError, UsageError
from share.files.reading import open_regular
from share.files.writing import fresh, writing
from share.mapping.changes import Kept
from share.store import connect, reading, schema
from share.store.connect import DamageError, complaints
from share.store.salvage import copied, finish, salvage, whole_of, whole_rows, with_copies


def examine(path: Path) -> Kept:
    """All of a map file, before it is opened for writing; brought up to date or salvaged first."""
    finish(path)
    if not connect.check_is_map(path):
        return Kept()
    try:
        found = _version(path)
        if found < schema.SCHEMA:
            _bring_up_to_date(path, found)
        return _contents(path)
    except DamageError:
        whole, beside = salvage(path)
        return _with(
            reading.kept(whole),
            f"the file was damaged; it is kept as {beside.name}, what is whole was taken over",
        )


def look(path: Path) -> tuple[Kept, int]:
    """All of a map file and its schema, the file left as it is."""
    if not connect.check_is_map(path):
        raise UsageError(f"{path}: there is no map in it")
    try:
        found = _version(path)
        if found == schema.SCHEMA:
            return _contents(path), found
        with copied(path) as copy:
            _migrate(copy, found)
            return _contents(copy), found
    except DamageError:
        kept = reading.kept(with_copies(whole_of(path)))
        return _with(kept, "the file is damaged; only what is whole was read"), schema.SCHEMA


def make(path: Path, power_cut: bool) -> sqlite3.Connection:
    """The writer's connection to a file that `examine` found good; its tables, if it has none."""
    with complaints(path, "opened"):
        connection = connect.for_writing(path, power_cut)
        if schema.is_empty(connection):
            connection.execute("BEGIN IMMEDIATE")
            schema.create(connection)
            connection.execute("COMMIT")
    return connection


def _version(path: Path) -> int:
    """Raises UsageError for a newer schema, DamageError if the file does not say."""
    with complaints(path, "opened"), contextlib.closing(connect.for_reading(path)) as connection:
        if schema.is_empty(connection) and connect.is_bare(path):
            return schema.SCHEMA
        found = schema.version(connection)
    if found is None:
        raise DamageError(f"{path}: the map is damaged: it does not say its schema")
    if found > schema.SCHEMA:
        raise UsageError(
            f"{path}: was made by a newer SHARE (schema {found}, this one knows {schema.SCHEMA}); "
            "use that, or give another file"
        )
    return found


def _contents(path: Path) -> Kept:
    """Raises DamageError unless every part of the file is whole."""
    connect.check_header(path)
    with complaints(path, "read"), contextlib.closing(connect.for_reading(path)) as connection:
        if schema.is_empty(connection):
            return Kept()
        if not schema.is_ours(connection):
            raise DamageError(f"{path}: the map is damaged: its tables")
        (verdict,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
        if verdict != "ok":
            raise DamageError(f"{path}: the map is damaged: {verdict}")
        found = whole_rows(connection)
    if found.damaged:
        raise DamageError(f"{path}: the map is damaged: its rows")
    return reading.kept(found)


def _bring_up_to_date(path: Path, found: int) -> None:
    """In place, after a copy was made."""
    with complaints(path, "opened"), contextlib.closing(connect.for_writing(path, True)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    copy = path.with_name(f"{path.name}.schema-{found}")
    with writing(path), open_regular(path) as old, fresh(copy) as new:
        shutil.copyfileobj(old, new)
    _migrate(path, found)


def _migrate(path: Path, found: int) -> None:
    if missing := [n for n in range(found, schema.SCHEMA) if n not in schema.STEPS]:
        raise UsageError(f"{path}: is of schema {missing[0]}, from which no way leads to {schema.SCHEMA}")
    try:
        with complaints(path, "brought up to date"), contextlib.closing(sqlite3.connect(path)) as connection:
            connection.isolation_level = None
            schema.migrate(connection, found, schema.STEPS)
    except DamageError as error:
        raise StoreError(f"{error}; it is of schema {found}: use the SHARE that made it") from None


def _with(kept: Kept, complaint: str) -> Kept:
    nothing = () if kept.complaints else ("nothing of it is lost",)
    return replace(kept, complaints=(complaint, *kept.complaints, *nothing))
