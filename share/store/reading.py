"""The rows of a map file as values, and what is missing as lines for a person."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from share.errors import StoreError, WireError
from share.mapping.changes import KeepPoses, Kept, KeptKeyframe
from share.mapping.loops import Key
from share.mapping.repair import mended
from share.store import rows
from share.store.rows import Row
from share.store.salvage import Found

_TIED = "keyframes lost the one before them and are tied to an earlier one"
_ABOUT = "rows about the file, and who speaks for which run, could not be read"
_UNSOLVED = "solutions could not be read: odometry and loops say where keyframes are"


def kept(found: Found) -> Kept:
    """What the rows say; they are taken out of `found`. Raises StoreError for another wire version."""
    following = {key: next for _, (key, next, *_) in found.tables["run"]}
    all_runs, bad_runs = _values(found, "run", rows.run)
    voices = rows.voices(found.tables["about"])
    runs = {run.key: replace(run, voice=voices.get(run.key, "")) for run in all_runs}
    keyframes, bad_keyframes = _values(found, "keyframe", rows.keyframe)
    homeless = [k for k in keyframes if k.key not in runs]
    links, bad_links = _values(found, "link", rows.link)
    loops, bad_loops = _values(found, "loop", rows.loop)
    poses, bad_poses = _values(found, "poses", rows.poses)
    whole = mended([k for k in keyframes if k.key in runs], {link.key: link for link in links})
    there = {k.at for k in whole.keyframes}
    tied = tuple(loop for loop in loops if loop.a in there and loop.b in there)
    lost = [
        _counted(found, "about", found.lost["about"], _ABOUT),
        _counted(found, "run", bad_runs, "agent runs could not be read"),
        _counted(found, "keyframe", bad_keyframes, "keyframes could not be read"),
        _counted(found, "", len(homeless), "keyframes are of a run that could not be read"),
        _counted(found, "", whole.tied if found.damaged else 0, _TIED),
        _counted(found, "link", bad_links, "odometry edges could not be read"),
        _counted(found, "loop", bad_loops, "loops could not be read"),
        _counted(found, "", len(loops) - len(tied), "loops led to lost keyframes"),
        _counted(found, "stretch", found.lost["stretch"], "stretches could not be read"),
        _counted(found, "poses", bad_poses, _UNSOLVED),
    ]
    return Kept(
        tuple(runs.values()),
        _stretches(found, whole.keyframes),
        whole.keyframes,
        whole.links,
        tied,
        _present(poses[0], there) if poses else None,
        _next(following, whole.keyframes),
        tuple(line for line in lost if line),
    )


def _counted(found: Found, table: str, lost: int, what: str) -> str:
    """One line, "" if nothing is lost."""
    if table in found.uncounted:
        return f"an unknown number of {what}"
    return f"{lost} {what}" if lost else ""


def _values(found: Found, table: str, value: Callable[[Row], Any]) -> tuple[list[Any], int]:
    """Values of a table's rows, and how many are lost. Takes the rows out, to save memory."""
    out, lost, numbered = [], found.lost[table], found.tables[table]
    of_another: StoreError | None = None
    numbered.reverse()
    while numbered:
        _, row = numbered.pop()
        try:
            out.append(value(row))
        except (ValueError, WireError):  # written by something that was wrong already
            lost += 1
        except StoreError as error:  # of another version, as all the others, or as nothing that we wrote
            of_another = error
            lost += 1
    if of_another is not None and not out:
        raise of_another
    return out, lost


def _stretches(found: Found, keyframes: Sequence[KeptKeyframe]) -> tuple[str, ...]:
    named = [rows.stretch_name(*row) for _, row in found.tables["stretch"]]
    return tuple(dict.fromkeys((*named, *(k.stretch for k in keyframes))))


def _next(following: dict[str, int], keyframes: Sequence[KeptKeyframe]) -> dict[str, int]:
    for keyframe in keyframes:
        following[keyframe.key] = max(following[keyframe.key], keyframe.at.id + 1)
    return following


def _present(poses: KeepPoses, there: set[Key]) -> KeepPoses:
    """Of keyframes that are there."""
    at = [i for i, key in enumerate(poses.keys) if key in there]
    return KeepPoses(tuple(poses.keys[i] for i in at), poses.T_map_body[at], tuple(poses.maps[i] for i in at))
