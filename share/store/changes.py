"""Each change as SQL, inside a transaction of the caller. Repeating one changes nothing."""

from __future__ import annotations

import sqlite3
from typing import Any

from share.mapping.changes import (
    Change,
    DropLoop,
    ForgetRun,
    KeepKeyframe,
    KeepLink,
    KeepLoop,
    KeepPoses,
    KeepRun,
    KeepVoice,
    Retire,
)
from share.mapping.loops import Key
from share.store import rows
from share.store.rows import COLUMNS, insert

_OF_RUN = (
    *(("run", "key"), ("run_copy", "key"), ("stretch", "run"), ("keyframe", "run"), ("link", "run")),
    *(("loop", "a_run"), ("loop", "b_run")),
)


def apply(db: sqlite3.Connection, change: Change) -> None:
    """Raises ValueError for a keyframe of a run that was never kept."""
    match change:
        case KeepRun():
            _run(db, change)
        case KeepVoice(run, voice):
            _voice(db, run, voice)
        case KeepKeyframe():
            _keyframe(db, change)
        case KeepLink():
            _forget(db, "link", change.key)
            insert(db, "link", rows.of_link(change))
        case KeepLoop():
            _loop(db, change)
        case DropLoop(a, b):
            for first, second in ((a, b), (b, a)):
                db.execute(
                    "DELETE FROM loop WHERE a_run = ? AND a_id = ? AND b_run = ? AND b_id = ?",
                    (*first, *second),
                )
        case Retire():
            for key in change.keys:
                _retire(db, key)
        case ForgetRun():
            _forget_run(db, change.key)
        case KeepPoses():
            db.execute("DELETE FROM poses")
            insert(db, "poses", rows.of_poses(change))


def _run(db: sqlite3.Connection, change: KeepRun) -> None:
    if not _one(db, "SELECT 1 FROM run WHERE key = ?", change.key):
        for table in ("run", "run_copy"):
            insert(db, table, rows.of_run(change, 0))
        _voice(db, change.key, change.voice)


def _voice(db: sqlite3.Connection, run: str, voice: str | None) -> None:
    row = rows.of_voice(run, voice or "")
    db.execute("DELETE FROM about WHERE name = ?", row[:1])
    if voice and _one(db, "SELECT 1 FROM run WHERE key = ?", run):
        insert(db, "about", row)


def _keyframe(db: sqlite3.Connection, change: KeepKeyframe) -> None:
    if change.at.id < _next(db, change.key):
        return
    stretch, ordinal = _place(db, change.key, begins=change.keyframe.reference < 0)
    insert(db, "keyframe", rows.of_keyframe(change, stretch, ordinal))


def _place(db: sqlite3.Connection, run: str, begins: bool) -> tuple[int, int]:
    """The run's newest stretch, since a keyframe refers to the one before it, or a new one; and its place."""
    (stretch,) = _one(db, "SELECT ifnull(max(nth), -1) FROM stretch WHERE run = ?", run)
    if begins or stretch < 0:
        insert(db, "stretch", (run, stretch + 1))
        return stretch + 1, 0
    newest = "SELECT stretch, ordinal FROM keyframe WHERE run = ? ORDER BY id DESC LIMIT 1"
    before, ordinal = _one(db, newest, run) or (-1, -1)
    return stretch, ordinal + 1 if before == stretch else 0


def _next(db: sqlite3.Connection, run: str) -> int:
    """One above all numbers that the run ever had."""
    known = _one(db, "SELECT next FROM run WHERE key = ?", run)
    if not known:
        raise ValueError(f"run {run} is not kept; its KeepRun comes first")
    (above,) = _one(db, "SELECT ifnull(max(id) + 1, 0) FROM keyframe WHERE run = ?", run)
    return max(int(known[0]), int(above))


def _loop(db: sqlite3.Connection, change: KeepLoop) -> None:
    row = rows.of_loop(change.loop)
    same = " AND ".join(f"{name} IS ?" for name in COLUMNS["loop"])
    if not _one(db, f"SELECT 1 FROM loop WHERE {same}", *row):
        insert(db, "loop", row)


def _retire(db: sqlite3.Connection, key: Key) -> None:
    following = _next(db, key.agent)
    for table in ("keyframe", "link"):
        _forget(db, table, key)
    db.execute("DELETE FROM loop WHERE a_run = ? AND a_id = ?", key)
    db.execute("DELETE FROM loop WHERE b_run = ? AND b_id = ?", key)
    if _next(db, key.agent) < following:  # it was the newest: the rest no longer says so
        _remember_next(db, key.agent, following)


def _forget_run(db: sqlite3.Connection, run: str) -> None:
    for table, column in _OF_RUN:
        db.execute(f"DELETE FROM {table} WHERE {column} = ?", (run,))
    _voice(db, run, None)


def _remember_next(db: sqlite3.Connection, run: str, following: int) -> None:
    for table in ("run", "run_copy"):
        number, codec, hello = _one(db, f"SELECT number, codec, hello FROM {table} WHERE key = ?", run)
        db.execute(f"DELETE FROM {table} WHERE number = ?", (number,))
        insert(db, table, (run, following, codec, hello), number)


def _forget(db: sqlite3.Connection, table: str, key: Key) -> None:
    db.execute(f"DELETE FROM {table} WHERE run = ? AND id = ?", key)


def _one(db: sqlite3.Connection, query: str, *values: Any) -> tuple[Any, ...]:
    """The first row, or ()."""
    return db.execute(query, values).fetchone() or ()
