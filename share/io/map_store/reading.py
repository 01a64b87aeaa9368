"""All that is whole in a map file, as values; what is not is counted, never guessed."""

from __future__ import annotations

import contextlib
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from share.core.keeping import KeepKeyframe, KeepPoses, Kept
from share.core.mending import mended
from share.errors import WireError
from share.io.map_store import rows
from share.io.map_store.connect import BROKEN
from share.io.map_store.rows import COLUMNS, Row, is_whole
from share.merge.join import Key

PROBES = 100_000  # numbers looked up one by one between two parts of a damaged table


@dataclass
class Found:
    """Whole rows by table, with their numbers, and how many others there are."""

    tables: dict[str, list[tuple[int, Row]]] = field(default_factory=dict)
    lost: Counter[str] = field(default_factory=Counter)

    def size(self) -> int:
        return sum(map(len, self.tables.values()))

    @property
    def damaged(self) -> bool:
        return any(self.lost.values())


def whole_rows(connection: sqlite3.Connection) -> Found:
    """Every row of every table that can be read and whose CRC is right."""
    found = Found()
    for table in COLUMNS:
        everything = dict(_scan(connection, table))
        good = {n: row for n, row in everything.items() if is_whole(table, n, row)}
        found.tables[table] = [(n, row[:-1]) for n, row in sorted(good.items())]
        found.lost[table] = max(_count(connection, table), len(everything)) - len(good)
    return found


def with_copies(found: Found) -> Found:
    """Runs that can be read in only one of their two tables, in both."""
    first, second = (dict(found.tables[table]) for table in ("run", "run_copy"))
    both = sorted((second | first).items())
    there = max(len(first) + found.lost["run"], len(second) + found.lost["run_copy"])
    lost = found.lost.copy()
    lost["run"], lost["run_copy"] = there - len(both), 0
    return Found(found.tables | {"run": both, "run_copy": both}, lost)


def _scan(connection: sqlite3.Connection, table: str) -> Iterator[tuple[int, Row]]:
    """From the front; where that breaks, from the back; and in between number by number."""
    columns = ", ".join(COLUMNS[table])
    select = f"SELECT number, {columns}, crc FROM {table} NOT INDEXED"
    low, high = 0, None
    try:
        connection.execute(f"{select} LIMIT 0")
    except BROKEN:
        return  # not even the table is known
    try:
        for number, *row in connection.execute(f"{select} ORDER BY number"):
            low = number
            yield number, tuple(row)
        return
    except BROKEN:
        pass
    with contextlib.suppress(*BROKEN):
        for number, *row in connection.execute(f"{select} WHERE number > ? ORDER BY number DESC", (low,)):
            high = number
            yield number, tuple(row)
    for number in range(low + 1, min(high or low + PROBES, low + PROBES)):
        with contextlib.suppress(*BROKEN):
            for _, *row in connection.execute(f"{select} WHERE number = ?", (number,)):
                yield number, tuple(row)


def _count(connection: sqlite3.Connection, table: str) -> int:
    """As an index has it, which is another part of the file; 0 where that cannot be read either."""
    try:
        return int(connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0])
    except BROKEN:
        return 0


# ---------------------------------------------------------------- values


def kept(found: Found) -> Kept:
    """What the rows say. Raises StoreError if they are of another wire version."""
    all_runs, bad_runs = _values(found, "run", rows.run)
    runs = {run.key: run for run in all_runs}
    keyframes, bad_keyframes = _values(found, "keyframe", rows.keyframe)
    homeless = [k for k in keyframes if k.key not in runs]
    links, bad_links = _values(found, "link", rows.link)
    loops, bad_loops = _values(found, "loop", rows.loop)
    poses, bad_poses = _values(found, "poses", rows.poses)
    whole = mended([k for k in keyframes if k.key in runs], {link.key: link for link in links})
    there = {k.at for k in whole.keyframes}
    tied = tuple(loop for loop in loops if loop.a in there and loop.b in there)
    lost = {
        "agent runs could not be read": bad_runs,
        "keyframes could not be read": bad_keyframes,
        "keyframes are of a run that could not be read": len(homeless),
        "keyframes lost the one before them and are tied to an earlier one": whole.tied,
        "odometry edges could not be read": bad_links,
        "loops could not be read": bad_loops,
        "loops led to lost keyframes": len(loops) - len(tied),
        "stretches could not be read": found.lost["stretch"],
        "solutions could not be read: odometry and loops say where keyframes are": bad_poses,
    }
    return Kept(
        tuple(runs.values()),
        _stretches(found, whole.keyframes),
        whole.keyframes,
        whole.links,
        tied,
        _present(poses[0], there) if poses else None,
        _next(found, whole.keyframes),
        tuple(f"{n} {what}" for what, n in lost.items() if n),
    )


def _values(found: Found, table: str, value: Callable[[Row], Any]) -> tuple[list[Any], int]:
    """Values of a table's rows, and how many are lost."""
    out, lost = [], found.lost[table]
    for _, row in found.tables[table]:
        try:
            out.append(value(row))
        except (ValueError, WireError):  # written by something that was wrong already
            lost += 1
    return out, lost


def _stretches(found: Found, keyframes: Sequence[KeepKeyframe]) -> tuple[str, ...]:
    named = [row[0] for _, row in found.tables["stretch"]]
    return tuple(dict.fromkeys((*named, *(k.stretch for k in keyframes))))


def _next(found: Found, keyframes: Sequence[KeepKeyframe]) -> dict[str, int]:
    out = {key: following for _, (key, following, *_) in found.tables["run"]}
    for keyframe in keyframes:
        out[keyframe.key] = max(out[keyframe.key], keyframe.at.id + 1)
    return out


def _present(poses: KeepPoses, there: set[Key]) -> KeepPoses:
    """Of keyframes that are there."""
    at = [i for i, key in enumerate(poses.keys) if key in there]
    return KeepPoses(tuple(poses.keys[i] for i in at), poses.T_map_body[at], tuple(poses.maps[i] for i in at))
