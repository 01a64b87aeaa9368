"""Loading of a map file: check that it is one and intact, salvage a damaged one, and decode its rows.

Each kind of loss costs a line in `StoredMap.problems`.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from share.errors import StoreError, UsageError, WireError
from share.mapping.keyframe_removal import reconnect
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import SaveLink, SavePoses, StoredKeyframe, StoredMap, odometry_link
from share.protocol.room_objects import MAX_OBJECTS
from share.store import database, rows, schema
from share.store.conversion import convert
from share.store.database import DamageError, translate_errors
from share.store.rows import Row
from share.store.salvage import (
    ReadRows,
    finish_salvage,
    merge_run_copies,
    read_damaged,
    read_intact_rows,
    salvage,
)
from share.types import Keyframe

_RECONNECTED = "keyframes lost their predecessor and are linked to an earlier one"
_ABOUT_LOST = "rows about the file, the credentials of runs and forgotten runs could not be read"
_FORGOTTEN_LOST = "forgotten runs could not be read: their agents may send what was deleted again"
_OBJECTS_LEFT_OUT = f"objects of the room are too many ({MAX_OBJECTS} at most) and stay in the file unused"
_SOLUTIONS_LOST = "solutions could not be read: keyframes are placed by odometry and loops"


@dataclass(frozen=True, eq=False)
class OpenedMap:
    """The content of a map file: its rows, without images and views, and its losses, a line each."""

    rows: ReadRows
    problems: tuple[str, ...] = ()


def read_and_repair(path: Path) -> OpenedMap:
    """Read a map file before it is opened for writing; salvage it if needed."""
    finished = finish_salvage(path)
    if not database.check_is_map(path):
        return OpenedMap(ReadRows.empty())
    try:
        opened = _opened(_read_intact(path))
        if finished != path:
            opened = replace(opened, problems=(damage_text(finished), UNCOUNTED, *opened.problems))
        return opened
    except DamageError:
        salvaged, renamed = salvage(path)
        problems = _with_problem(decode_map(salvaged), damage_text(renamed)).problems
        return OpenedMap(_read_intact(path), problems)


UNCOUNTED = "the repair was interrupted: how much was lost was not counted"


def damage_text(renamed: Path) -> str:
    """The fate of a damaged file, which has another name now."""
    return f"the file was damaged; it is kept as {renamed.name}, and its intact rows were taken over"


def read_only(path: Path) -> OpenedMap:
    """Read a map file without changing it."""
    if not database.check_is_map(path):
        raise UsageError(f"{path}: contains no map")
    try:
        return _opened(_read_intact(path))
    except DamageError:
        salvaged = merge_run_copies(read_damaged(path))
        complaint = "the file is damaged; only intact rows were read"
        return OpenedMap(salvaged, _with_problem(decode_map(salvaged.copy()), complaint).problems)


def _opened(read_rows: ReadRows) -> OpenedMap:
    return OpenedMap(read_rows, outline_map(read_rows).problems)


def open_writer(path: Path, durable: bool, now_s: float) -> sqlite3.Connection:
    """Open the writer's connection to a file that `read_and_repair` has checked; create or convert its
    tables. now_s: unix s, see `convert`."""
    with contextlib.ExitStack() as stack:  # a connection that stays open locks the file for the next try
        with translate_errors(path, "opened", writes=True):
            connection = stack.enter_context(contextlib.closing(database.open_for_writing(path, durable)))
            connection.execute("BEGIN IMMEDIATE")
            if schema.is_empty(connection):
                schema.create(connection)
            convert(connection, now_s)
            connection.execute("COMMIT")
        stack.pop_all()
    return connection


def _check_schema(path: Path) -> None:
    """Raises UsageError for another schema, DamageError if its number is unreadable."""
    with translate_errors(path, "opened"), contextlib.closing(database.open_for_reading(path)) as connection:
        if schema.is_empty(connection) and database.is_blank(path):
            return
        version = schema.read_version(connection)
    if version is None:
        raise DamageError(f"{path}: the map is damaged: its schema number is unreadable")
    if version > schema.SCHEMA:
        raise UsageError(
            f"{path}: was made by a newer SHARE (schema {version}, this one reads {schema.SCHEMA}); "
            "use that SHARE, or give another file"
        )
    if version < schema.OLDEST_SCHEMA:
        raise UsageError(
            f"{path}: was made before SHARE 0.1.0 (schema {version}), and no release reads it; "
            "give another file: the agents build the map anew"
        )


def _read_intact(path: Path) -> ReadRows:
    """Read all but `schema.LARGE_TABLES`. Raises DamageError if any part of it is damaged, UsageError for
    another schema.

    Large tables are most of the file: their rows are checked when they are read (`KeyframeArchive`), and a
    write that finds one damaged repairs the file (`MapStore.write`)."""
    _check_schema(path)
    database.check_header(path)
    with translate_errors(path, "read"), contextlib.closing(database.open_for_reading(path)) as connection:
        if schema.is_empty(connection):
            return ReadRows.empty()
        if not schema.matches_schema(connection):
            raise DamageError(f"{path}: the map is damaged: its tables")
        for table in sorted(schema.own_tables(connection) - {*schema.LARGE_TABLES}):
            (verdict,) = connection.execute(f"PRAGMA integrity_check({table})").fetchone()
            if verdict != "ok":
                raise DamageError(f"{path}: the map is damaged: {verdict}")
        read_rows = read_intact_rows(connection, schema.SMALL_TABLES)
    if read_rows.is_damaged:
        raise DamageError(f"{path}: the map is damaged: its rows")
    return read_rows


def _with_problem(loaded: StoredMap, complaint: str) -> StoredMap:
    nothing_lost = () if loaded.problems else ("nothing is lost",)
    return replace(loaded, problems=(complaint, *loaded.problems, *nothing_lost))


# ---- Rows to values


def outline_map(read_rows: ReadRows) -> StoredMap:
    """Decode the part that runs continue from: the newest keyframe of each run, and those without a pose.

    Decoding all keyframes takes seconds for 20,000. If a row cannot be decoded, all rows are, so that
    `problems` lists the losses. Raises StoreError for another wire version.
    """
    try:
        return _outline(read_rows)
    except (ValueError, KeyError, WireError, StoreError):
        return decode_map(read_rows.copy())


def _outline(read_rows: ReadRows) -> StoredMap:
    tables = {table: [row for _, row in numbered] for table, numbered in read_rows.tables.items()}
    credentials = rows.read_credentials(read_rows.tables["about"])
    runs = {row[0]: rows.read_run(row) for row in tables["run"]}
    keys = {KeyframeKey(*row[:2]) for row in tables["keyframe"]}
    newest = {row[0]: row[1] for row in tables["keyframe"]}
    solved = next((_present_poses(rows.read_poses(row), keys) for row in tables["poses"]), None)
    posed = set() if solved is None else set(solved.keys)
    keyframes = tuple(
        rows.read_keyframe(row)
        for row in tables["keyframe"]
        if newest[row[0]] == row[1] or row[:2] not in posed
    )
    chosen = {runs[keyframe.run_key].run_key: keyframe for keyframe in keyframes}  # KeyError without its run
    links = [rows.read_link(row) for row in tables["link"] if row[0] in chosen and row[:2] not in posed]
    next_ids = {row[0]: row[1] for row in tables["run"]}
    objects, lost_objects = rows.read_objects(read_rows.tables["about"])
    forgotten, lost_forgotten = rows.read_forgotten_runs(read_rows.tables["about"])
    if lost_objects or len(objects) > MAX_OBJECTS or lost_forgotten:
        raise ValueError("objects, or forgotten runs")
    return StoredMap(
        tuple(replace(run, credential=credentials.get(key, "")) for key, run in runs.items()),
        (),
        keyframes,
        {link.key: link for link in links},
        tuple(rows.read_loop(row) for row in tables["loop"]),
        solved,
        {key: max(next_ids[key], newest.get(key, -1) + 1) for key in runs},
        objects=objects,
        forgotten=forgotten,
    )


def decode_map(read_rows: ReadRows) -> StoredMap:
    """Decode `read_rows` and empty it. Raises StoreError for another wire version."""
    next_ids = {key: next for _, (key, next, *_) in read_rows.tables["run"]}
    all_runs, lost_runs = _decode_rows(read_rows, "run", rows.read_run)
    credentials = rows.read_credentials(read_rows.tables["about"])
    runs = {run.run_key: replace(run, credential=credentials.get(run.run_key, "")) for run in all_runs}
    keyframes, lost_keyframes = _decode_rows(read_rows, "keyframe", rows.read_keyframe)
    orphans = [k for k in keyframes if k.run_key not in runs]
    links, lost_links = _decode_rows(read_rows, "link", rows.read_link)
    loops, lost_loops = _decode_rows(read_rows, "loop", rows.read_loop)
    poses, lost_poses = _decode_rows(read_rows, "poses", rows.read_poses)
    arrivals = dict(_decode_rows(read_rows, "arrival", rows.read_arrival)[0])
    repaired = repair_references(
        [replace(k, arrived_s=arrivals.get(k.keyframe_key)) for k in keyframes if k.run_key in runs],
        {link.key: link for link in links},
    )
    known_keys = {k.keyframe_key for k in repaired.keyframes}
    connected_loops = tuple(loop for loop in loops if loop.a in known_keys and loop.b in known_keys)
    segments, lost_segments = _decode_rows(read_rows, "stretch", rows.read_segment)
    objects, lost_objects = rows.read_objects(read_rows.tables["about"])
    forgotten, lost_forgotten = rows.read_forgotten_runs(read_rows.tables["about"])
    complaints = [
        _loss_line(read_rows, "about", read_rows.lost_counts["about"], _ABOUT_LOST),
        _loss_line(read_rows, "run", lost_runs, "agent runs could not be read"),
        _loss_line(read_rows, "keyframe", lost_keyframes, "keyframes could not be read"),
        _loss_line(read_rows, "", len(orphans), "keyframes belong to a run that could not be read"),
        _loss_line(read_rows, "", repaired.reconnected_count if read_rows.is_damaged else 0, _RECONNECTED),
        _loss_line(read_rows, "link", lost_links, "odometry edges could not be read"),
        _loss_line(read_rows, "loop", lost_loops, "loops could not be read"),
        _loss_line(read_rows, "", len(loops) - len(connected_loops), "loops led to lost keyframes"),
        _loss_line(read_rows, "stretch", lost_segments, "segments could not be read"),
        _loss_line(read_rows, "poses", lost_poses, _SOLUTIONS_LOST),
        _loss_line(read_rows, "", lost_objects, "objects of the room could not be read"),
        _loss_line(read_rows, "", max(0, len(objects) - MAX_OBJECTS), _OBJECTS_LEFT_OUT),
        _loss_line(read_rows, "", lost_forgotten, _FORGOTTEN_LOST),
    ]
    return StoredMap(
        tuple(runs.values()),
        tuple(dict.fromkeys((*segments, *(k.segment_name for k in repaired.keyframes)))),
        repaired.keyframes,
        repaired.links,
        connected_loops,
        _present_poses(poses[0], known_keys) if poses else None,
        _next_ids(next_ids, repaired.keyframes),
        tuple(line for line in complaints if line),
        objects,
        forgotten,
    )


def _loss_line(read_rows: ReadRows, table: str, lost_count: int, what: str) -> str:
    """Return one line, "" if nothing is lost."""
    if table in read_rows.uncounted:
        return f"an unknown number of {what}"
    return f"{lost_count} {what}" if lost_count else ""


def _decode_rows(read_rows: ReadRows, table: str, decode: Callable[[Row], Any]) -> tuple[list[Any], int]:
    """Return the values of a table's rows and the number of lost ones. Removes the rows, to save memory."""
    out, lost_count, numbered = [], read_rows.lost_counts[table], read_rows.tables[table]
    version_error: StoreError | None = None
    numbered.reverse()
    while numbered:
        _, row = numbered.pop()
        try:
            out.append(decode(row))
        except (ValueError, WireError):  # an invalid value with a correct CRC
            lost_count += 1
        except StoreError as error:  # another wire version; fatal only if no row can be decoded
            version_error = error
            lost_count += 1
    if version_error is not None and not out:
        raise version_error
    return out, lost_count


def _next_ids(next_ids: dict[str, int], keyframes: Sequence[StoredKeyframe]) -> dict[str, int]:
    for keyframe in keyframes:
        next_ids[keyframe.run_key] = max(next_ids[keyframe.run_key], keyframe.keyframe_key.id + 1)
    return next_ids


def _present_poses(poses: SavePoses, known_keys: set[KeyframeKey]) -> SavePoses:
    """Return the poses of known keyframes."""
    indices = [i for i, key in enumerate(poses.keys) if key in known_keys]
    return SavePoses(
        tuple(poses.keys[i] for i in indices),
        poses.T_map_body[indices],
        tuple(poses.map_ids[i] for i in indices),
    )


# ---- Repair of keyframes without their reference


@dataclass(frozen=True, eq=False)
class Repaired:
    """keyframes, links: with every reference present. reconnected_count: keyframes whose edge was rebuilt."""

    keyframes: tuple[StoredKeyframe, ...]
    links: dict[KeyframeKey, SaveLink]
    reconnected_count: int


def repair_references(keyframes: Sequence[StoredKeyframe], links: Mapping[KeyframeKey, SaveLink]) -> Repaired:
    """Connect each keyframe without its reference to the nearest earlier one on its segment.

    keyframes: in order of arrival. A keyframe without an earlier one begins its segment.
    """
    out: list[StoredKeyframe] = []
    current_links = dict(links)
    newest_in_segment: dict[str, Keyframe] = {}
    present_keys: set[KeyframeKey] = set()
    reconnected_count = 0
    for stored in keyframes:
        key = stored.keyframe_key
        reference = (current_links.get(key) or stored.keyframe).reference
        if reference >= 0 and KeyframeKey(stored.run_key, reference) not in present_keys:
            edge = odometry_link(stored, current_links)
            newest = newest_in_segment.get(stored.segment_name)
            previous = None if newest is None else (newest.id, newest.T_odom_body)
            edge = reconnect(stored.run_key, _with_edge(stored.keyframe, edge), previous)
            if key in current_links:
                current_links[key] = edge
            else:  # as if its agent had sent this edge: the covariance is not yet inflated
                stored = replace(stored, keyframe=_with_edge(stored.keyframe, edge))
            reconnected_count += 1
        out.append(stored)
        newest_in_segment[stored.segment_name] = stored.keyframe
        present_keys.add(key)
    present_links = {key: link for key, link in current_links.items() if key in present_keys}
    return Repaired(tuple(out), present_links, reconnected_count)


def _with_edge(keyframe: Keyframe, edge: SaveLink) -> Keyframe:
    return replace(keyframe, reference=edge.reference, T_ref_body=edge.T_ref_body, cov=edge.cov)
