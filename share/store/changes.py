"""Changes of the map as SQL, within the caller's transaction."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Mapping
from typing import Any

from share.errors import StoreError, WireError
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import (
    MAX_FORGOTTEN_RUNS,
    MapChange,
    RemoveKeyframes,
    RemoveLoops,
    RemoveRun,
    RemoveStoredObject,
    SaveCredential,
    SaveKeyframe,
    SaveLink,
    SaveLoop,
    SaveObject,
    SavePoses,
    SaveRun,
    SaveView,
)
from share.store import rows
from share.store.rows import COLUMNS, FORGOTTEN_PREFIX, insert
from share.wire.messages import public_tag

_RUN_COLUMNS = (
    *(("run", "key"), ("run_copy", "key"), ("stretch", "run"), ("keyframe", "run"), ("link", "run")),
    *(("loop", "a_run"), ("loop", "b_run"), ("arrival", "run"), ("image", "run"), ("view", "run")),
)


def apply_change(db: sqlite3.Connection, change: MapChange, now_s: float) -> None:
    """Apply one change; again it changes nothing. now_s: unix s. Raises ValueError for a keyframe of an
    unknown run."""
    match change:
        case SaveRun():
            _insert_run(db, change)
        case SaveCredential(run, credential):
            _set_credential(db, run, credential)
        case SaveKeyframe():
            _insert_keyframe(db, change, now_s)
        case SaveLink():
            _delete_row(db, "link", change.key)
            insert(db, "link", rows.link_row(change))
        case SaveView():
            _insert_view(db, change)
        case SaveLoop():
            _insert_loop(db, change)
        case RemoveLoops(a, b):
            for first, second in ((a, b), (b, a)):
                db.execute(
                    "DELETE FROM loop WHERE a_run = ? AND a_id = ? AND b_run = ? AND b_id = ?",
                    (*first, *second),
                )
        case RemoveKeyframes():
            for key in change.keys:
                _remove_keyframe(db, key)
        case RemoveRun():
            _delete_run(db, change.run_key)
        case SavePoses():
            db.execute("DELETE FROM poses")
            insert(db, "poses", rows.poses_row(change))
        case SaveObject():
            row = rows.object_row(change)
            db.execute("DELETE FROM about WHERE name = ?", row[:1])
            insert(db, "about", row)
        case RemoveStoredObject(object_id):
            db.execute("DELETE FROM about WHERE name = ?", (rows.object_name(object_id),))


def _insert_run(db: sqlite3.Connection, change: SaveRun) -> None:
    if not first_row(db, "SELECT 1 FROM run WHERE key = ?", change.run_key):
        next_id = _take_forgotten(db, public_tag(change.hello.run_id))
        for table in ("run", "run_copy"):
            insert(db, table, rows.run_row(change, next_id))
        _set_credential(db, change.run_key, change.credential)


def _set_credential(db: sqlite3.Connection, run: str, credential: str | None) -> None:
    row = rows.credential_row(run, credential or "")
    db.execute("DELETE FROM about WHERE name = ?", row[:1])
    if credential and first_row(db, "SELECT 1 FROM run WHERE key = ?", run):
        insert(db, "about", row)


def _insert_keyframe(db: sqlite3.Connection, change: SaveKeyframe, now_s: float) -> None:
    if change.keyframe_key.id < _next_id(db, change.run_key):
        return
    segment, ordinal = _segment_and_ordinal(db, change.run_key, starts_segment=change.keyframe.reference < 0)
    insert(db, "keyframe", rows.keyframe_row(change, segment, ordinal))
    insert(db, "arrival", rows.arrival_row(change.keyframe_key, now_s))
    if len(jpeg := change.keyframe.image.jpeg):
        insert(db, "image", rows.image_row(change.keyframe_key, jpeg))


def _insert_view(db: sqlite3.Connection, change: SaveView) -> None:
    _delete_row(db, "view", change.key)
    if first_row(db, "SELECT 1 FROM keyframe WHERE run = ? AND id = ?", *change.key):
        insert(db, "view", rows.view_row(change))


def _segment_and_ordinal(db: sqlite3.Connection, run: str, starts_segment: bool) -> tuple[int, int]:
    """Return the number of the run's newest segment, or of a new one, and the keyframe's position in it."""
    (segment,) = first_row(db, "SELECT ifnull(max(nth), -1) FROM stretch WHERE run = ?", run)
    if starts_segment or segment < 0:
        insert(db, "stretch", (run, segment + 1))
        return segment + 1, 0
    newest = "SELECT stretch, ordinal FROM keyframe WHERE run = ? ORDER BY id DESC LIMIT 1"
    previous_segment, ordinal = first_row(db, newest, run) or (-1, -1)
    return segment, ordinal + 1 if previous_segment == segment else 0


def _next_id(db: sqlite3.Connection, run: str) -> int:
    """Return one more than the largest keyframe id that the run ever had."""
    row = first_row(db, "SELECT next FROM run WHERE key = ?", run)
    if not row:
        raise ValueError(f"run {run} is not in the file; its SaveRun must come first")
    (next_id,) = first_row(db, "SELECT ifnull(max(id) + 1, 0) FROM keyframe WHERE run = ?", run)
    return max(int(row[0]), int(next_id))


def _insert_loop(db: sqlite3.Connection, change: SaveLoop) -> None:
    row = rows.loop_row(change.loop)
    same = " AND ".join(f"{name} IS ?" for name in COLUMNS["loop"])
    if not first_row(db, f"SELECT 1 FROM loop WHERE {same}", *row):
        insert(db, "loop", row)


def _remove_keyframe(db: sqlite3.Connection, key: KeyframeKey) -> None:
    next_id = _next_id(db, key.agent)
    for table in ("keyframe", "link", "arrival", "image", "view"):
        _delete_row(db, table, key)
    db.execute("DELETE FROM loop WHERE a_run = ? AND a_id = ?", key)
    db.execute("DELETE FROM loop WHERE b_run = ? AND b_id = ?", key)
    if _next_id(db, key.agent) < next_id:  # it was the newest: the remaining rows do not show its id
        _store_next_id(db, key.agent, next_id)


def _delete_run(db: sqlite3.Connection, run: str) -> None:
    """Remove a run with its name; where keyframes of it were removed, it stays known by its tag."""
    row = _run_row(db, run)
    if row and (next_id := _next_id(db, run)):
        with contextlib.suppress(ValueError, WireError, StoreError):  # of another version: it has no tag here
            add_forgotten(db, {public_tag(rows.read_run(row).hello.run_id): next_id})
    for table, column in _RUN_COLUMNS:
        db.execute(f"DELETE FROM {table} WHERE {column} = ?", (run,))
    _set_credential(db, run, None)


def add_forgotten(db: sqlite3.Connection, next_ids: Mapping[str, int]) -> None:
    """Record removed runs by tag, each with the id after all that it had; of too many drop the oldest."""
    for tag, next_id in next_ids.items():
        row = rows.forgotten_row(tag, next_id)
        db.execute("DELETE FROM about WHERE name = ?", row[:1])
        insert(db, "about", row)
    (count,) = first_row(db, "SELECT count(*) FROM about WHERE name GLOB ?", f"{FORGOTTEN_PREFIX}*")
    oldest = "SELECT number FROM about NOT INDEXED WHERE name GLOB ? ORDER BY number LIMIT ?"
    if (excess := count - MAX_FORGOTTEN_RUNS) > 0:
        db.execute(f"DELETE FROM about WHERE number IN ({oldest})", (f"{FORGOTTEN_PREFIX}*", excess))


def _take_forgotten(db: sqlite3.Connection, tag: str) -> int:
    """Return the id after all that a run had before it was removed, 0 if it is new, and drop the record."""
    name = f"{FORGOTTEN_PREFIX}{tag}"
    about = db.execute("SELECT name, value FROM about WHERE name = ?", (name,)).fetchall()
    db.execute("DELETE FROM about WHERE name = ?", (name,))
    return rows.read_forgotten_runs([(0, row) for row in about])[0].get(tag, 0)


def _store_next_id(db: sqlite3.Connection, run: str, next_id: int) -> None:
    _, _, codec, hello = _run_row(db, run)
    for table in ("run", "run_copy"):
        (number,) = first_row(db, f"SELECT number FROM {table} WHERE key = ?", run)
        db.execute(f"DELETE FROM {table} WHERE number = ?", (number,))
        insert(db, table, (run, next_id, codec, hello), number)


def _run_row(db: sqlite3.Connection, run: str) -> rows.Row:
    """Return the row of a run, from the one of its tables where it is intact; () without one."""
    select = f"SELECT number, {', '.join(COLUMNS['run'])}, crc FROM"
    copies = {table: first_row(db, f"{select} {table} WHERE key = ?", run) for table in ("run", "run_copy")}
    intact = [row for table, row in copies.items() if row and rows.is_intact(table, row[0], row[1:])]
    return next(iter(intact), copies["run"])[1:-1]


def _delete_row(db: sqlite3.Connection, table: str, key: KeyframeKey) -> None:
    db.execute(f"DELETE FROM {table} WHERE run = ? AND id = ?", key)


def first_row(db: sqlite3.Connection, query: str, *values: Any) -> tuple[Any, ...]:
    """Return the first row, or ()."""
    return db.execute(query, values).fetchone() or ()
