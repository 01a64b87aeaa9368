"""Conversion of an intact map file of an older schema, within the writer's transaction."""

from __future__ import annotations

import contextlib
import sqlite3

from share.errors import StoreError, WireError
from share.mapping.loops import KeyframeKey
from share.store import rows, schema

_UNDATED = "SELECT run, id FROM keyframe WHERE (run, id) NOT IN (SELECT run, id FROM arrival) ORDER BY number"


def convert(connection: sqlite3.Connection, now_s: float) -> None:
    """Add the tables that an older file lacks, and fill them.

    Keyframes without a time of arrival, those of an older schema and those whose time was lost, count as
    arrived at now_s (unix s).
    """
    if schema.add_tables(connection):
        move_images(connection)
    for run, id in connection.execute(_UNDATED).fetchall():
        rows.insert(connection, "arrival", rows.arrival_row(KeyframeKey(run, id), now_s))


def move_images(connection: sqlite3.Connection) -> None:
    """Move the JPEGs of keyframes, which schema 3 has in their messages, to the table of images."""
    columns = ", ".join(rows.COLUMNS["keyframe"])
    for (number,) in connection.execute("SELECT number FROM keyframe ORDER BY number").fetchall():
        row = connection.execute(f"SELECT {columns} FROM keyframe WHERE number = ?", (number,)).fetchone()
        with contextlib.suppress(ValueError, WireError, StoreError):  # it cannot be read, and stays as it is
            stored, (_, _, segment, ordinal, *_) = rows.read_keyframe(row), row
            if not len(jpeg := stored.keyframe.image.jpeg):
                continue
            connection.execute("DELETE FROM keyframe WHERE number = ?", (number,))
            rows.insert(connection, "keyframe", rows.keyframe_row(stored, segment, ordinal), number)
            rows.insert(connection, "image", rows.image_row(stored.keyframe_key, jpeg))
