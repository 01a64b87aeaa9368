"""Decode the rows of a map file to a `StoredMap`, with a line for each kind of loss."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from share.errors import StoreError, WireError
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import SavePoses, StoredKeyframe, StoredMap
from share.mapping.repair import repair_references
from share.store import rows
from share.store.rows import Row
from share.store.salvage import ReadRows

_RECONNECTED = "keyframes lost their predecessor and are linked to an earlier one"
_ABOUT_LOST = "rows about the file and the credentials of runs could not be read"
_SOLUTIONS_LOST = "solutions could not be read: keyframes are placed by odometry and loops"


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
    repaired = repair_references(
        [k for k in keyframes if k.run_key in runs], {link.key: link for link in links}
    )
    known_keys = {k.keyframe_key for k in repaired.keyframes}
    connected_loops = tuple(loop for loop in loops if loop.a in known_keys and loop.b in known_keys)
    complaints = [
        _loss_line(read_rows, "about", read_rows.lost_counts["about"], _ABOUT_LOST),
        _loss_line(read_rows, "run", lost_runs, "agent runs could not be read"),
        _loss_line(read_rows, "keyframe", lost_keyframes, "keyframes could not be read"),
        _loss_line(read_rows, "", len(orphans), "keyframes belong to a run that could not be read"),
        _loss_line(read_rows, "", repaired.reconnected_count if read_rows.is_damaged else 0, _RECONNECTED),
        _loss_line(read_rows, "link", lost_links, "odometry edges could not be read"),
        _loss_line(read_rows, "loop", lost_loops, "loops could not be read"),
        _loss_line(read_rows, "", len(loops) - len(connected_loops), "loops led to lost keyframes"),
        _loss_line(read_rows, "stretch", read_rows.lost_counts["stretch"], "segments could not be read"),
        _loss_line(read_rows, "poses", lost_poses, _SOLUTIONS_LOST),
    ]
    return StoredMap(
        tuple(runs.values()),
        _segment_names(read_rows, repaired.keyframes),
        repaired.keyframes,
        repaired.links,
        connected_loops,
        _present_poses(poses[0], known_keys) if poses else None,
        _next_ids(next_ids, repaired.keyframes),
        tuple(line for line in complaints if line),
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


def _segment_names(read_rows: ReadRows, keyframes: Sequence[StoredKeyframe]) -> tuple[str, ...]:
    named = [rows.segment_name(*row) for _, row in read_rows.tables["stretch"]]
    return tuple(dict.fromkeys((*named, *(k.segment_name for k in keyframes))))


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
