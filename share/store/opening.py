"""Open a map file: check that it is one and intact, migrate an older schema, salvage a damaged file."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

from share.errors import StoreError, UsageError
from share.files.reading import open_regular
from share.files.writing import open_new, write_errors
from share.mapping.map_changes import StoredMap
from share.store import database, decoding, schema
from share.store.database import DamageError, translate_errors
from share.store.salvage import (
    finish_salvage,
    merge_run_copies,
    read_damaged,
    read_intact_rows,
    salvage,
    temporary_copy,
)


def load_and_repair(path: Path) -> StoredMap:
    """Read a whole map file before it is opened for writing; migrate or salvage it if needed."""
    finish_salvage(path)
    if not database.check_is_map(path):
        return StoredMap()
    try:
        version = _read_schema(path)
        if version < schema.SCHEMA:
            _upgrade(path, version)
        return _load_intact(path)
    except DamageError:
        salvaged, renamed = salvage(path)
        return _with_complaint(
            decoding.decode_map(salvaged),
            f"the file was damaged; it is kept as {renamed.name}, and its intact rows were taken over",
        )


def load_read_only(path: Path) -> tuple[StoredMap, int]:
    """Read a whole map file and its schema without changing the file."""
    if not database.check_is_map(path):
        raise UsageError(f"{path}: contains no map")
    try:
        version = _read_schema(path)
        if version == schema.SCHEMA:
            return _load_intact(path), version
        with temporary_copy(path) as copy:
            _migrate(copy, version)
            return _load_intact(copy), version
    except DamageError:
        salvaged = decoding.decode_map(merge_run_copies(read_damaged(path)))
        return _with_complaint(salvaged, "the file is damaged; only intact rows were read"), schema.SCHEMA


def open_writer(path: Path, durable: bool) -> sqlite3.Connection:
    """Open the writer's connection to a file that `load_and_repair` has checked; create missing tables."""
    with translate_errors(path, "opened"):
        connection = database.open_for_writing(path, durable)
        if schema.is_empty(connection):
            connection.execute("BEGIN IMMEDIATE")
            schema.create(connection)
            connection.execute("COMMIT")
    return connection


def _read_schema(path: Path) -> int:
    """Return the schema number. Raises UsageError for a newer schema, DamageError if it is unreadable."""
    with translate_errors(path, "opened"), contextlib.closing(database.open_for_reading(path)) as connection:
        if schema.is_empty(connection) and database.is_blank(path):
            return schema.SCHEMA
        version = schema.read_version(connection)
    if version is None:
        raise DamageError(f"{path}: the map is damaged: its schema number is unreadable")
    if version > schema.SCHEMA:
        raise UsageError(
            f"{path}: was made by a newer SHARE (schema {version}, this one reads {schema.SCHEMA}); "
            "use that SHARE, or give another file"
        )
    return version


def _load_intact(path: Path) -> StoredMap:
    """Read the map. Raises DamageError unless every part of the file is intact."""
    database.check_header(path)
    with translate_errors(path, "read"), contextlib.closing(database.open_for_reading(path)) as connection:
        if schema.is_empty(connection):
            return StoredMap()
        if not schema.matches_schema(connection):
            raise DamageError(f"{path}: the map is damaged: its tables")
        (verdict,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
        if verdict != "ok":
            raise DamageError(f"{path}: the map is damaged: {verdict}")
        read_rows = read_intact_rows(connection)
    if read_rows.is_damaged:
        raise DamageError(f"{path}: the map is damaged: its rows")
    return decoding.decode_map(read_rows)


def _upgrade(path: Path, version: int) -> None:
    """Copy the file to FILE.schema-N, then migrate it in place."""
    with (
        translate_errors(path, "opened"),
        contextlib.closing(database.open_for_writing(path, True)) as connection,
    ):
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    copy = path.with_name(f"{path.name}.schema-{version}")
    with write_errors(path), open_regular(path) as old, open_new(copy) as new:
        shutil.copyfileobj(old, new)
    _migrate(path, version)


def _migrate(path: Path, version: int) -> None:
    if missing := [n for n in range(version, schema.SCHEMA) if n not in schema.MIGRATIONS]:
        raise UsageError(f"{path}: has schema {missing[0]}, which cannot be migrated to {schema.SCHEMA}")
    try:
        with (
            translate_errors(path, "migrated"),
            contextlib.closing(sqlite3.connect(path)) as connection,
        ):
            connection.isolation_level = None
            schema.migrate(connection, version, schema.MIGRATIONS)
    except DamageError as error:
        raise StoreError(f"{error}; it has schema {version}: use the SHARE that made it") from None


def _with_complaint(loaded: StoredMap, complaint: str) -> StoredMap:
    nothing_lost = () if loaded.problems else ("nothing is lost",)
    return replace(loaded, problems=(complaint, *loaded.problems, *nothing_lost))
