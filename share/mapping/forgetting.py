"""Forgetting: keyframes that leave the map for good, by their age or their agent.

Culling (`share.mapping.culling`) removes keyframes that others resemble; forgetting removes them whatever
depends on them. The remaining keyframes keep their poses and the loops between them. Parts that only
forgotten keyframes connected become separate maps, since no measurement between them is left; new keyframes
join them again.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from share.config import Config
from share.mapping.atlas import Atlas
from share.mapping.keyframe_removal import RemovedKeyframe
from share.mapping.map_changes import (
    MapChange,
    RemoveKeyframes,
    RemoveRun,
    SaveLoop,
    SavePoses,
    StoredKeyframe,
    StoredMap,
    Wipe,
)
from share.mapping.segments import restored_ranks

DAY_S = 86_400.0


class Retention:
    """When each keyframe of the map arrived, and which are kept too long. Times are unix s, passed in."""

    def __init__(self, keep_days: float | None) -> None:
        """keep_days: how long keyframes are kept; None: for ever."""
        self._keep_s = None if keep_days is None else keep_days * DAY_S
        self._arrived_s: dict[int, float | None] = {}

    def add(self, node_id: int, arrived_s: float | None = None) -> None:
        """Add a keyframe. arrived_s: when it arrived; None: at the next call of `expired`."""
        if self._keep_s is not None:
            self._arrived_s[node_id] = arrived_s

    def remove(self, node_id: int) -> None:
        self._arrived_s.pop(node_id, None)

    def expired(self, now_s: float) -> list[int]:
        """Return the keyframes that are to be forgotten by now."""
        if self._keep_s is None:
            return []
        self._arrived_s = {n: now_s if s is None else s for n, s in self._arrived_s.items()}
        limit_s = now_s - self._keep_s
        return [n for n, s in self._arrived_s.items() if s is not None and s <= limit_s]


def forgetting_changes(removed: Sequence[RemovedKeyframe]) -> list[MapChange]:
    """Return what the map file has to change: links and loops of removed keyframes are not written."""
    keys = tuple(out.key for out in removed)
    gone = set(keys)
    links = {out.link.key: out.link for out in removed if out.link is not None and out.link.key not in gone}
    loops = [loop for out in removed for loop in out.moved_loops if loop.keyframes.isdisjoint(gone)]
    return [RemoveKeyframes(keys), *links.values(), *map(SaveLoop, loops), Wipe()]


@dataclass(frozen=True, eq=False)
class ForgettingPlan:
    """What forgetting changes in a stored map.

    removed, remaining: keyframes. loops: number of loops between the remaining ones; poses: of these.
    changes: for the map file.
    """

    removed: tuple[StoredKeyframe, ...]
    remaining: tuple[StoredKeyframe, ...]
    loops: int
    poses: SavePoses
    changes: tuple[MapChange, ...]


def plan_forgetting(
    stored_map: StoredMap, agents: Collection[str] | None, before_s: float | None
) -> ForgettingPlan:
    """Plan to forget the keyframes of agents of these names (None: of all) that arrived before a time, unix s
    (None: whenever they did). Runs without remaining keyframes are forgotten with their names.

    A keyframe whose time is unknown counts as new.
    """
    names = {run.run_key: run.hello.name for run in stored_map.runs}

    def is_selected(stored: StoredKeyframe) -> bool:
        is_old = before_s is None or (stored.arrived_s is not None and stored.arrived_s < before_s)
        return is_old and (agents is None or names[stored.run_key] in agents)

    atlas = Atlas(Config().merge)
    for run in stored_map.runs:
        atlas.add_run(run.run_key, run.hello.name, run.credential)
        atlas.set_present(run.run_key, False)
    node_ids = atlas.restore(stored_map, restored_ranks(Config(), stored_map))
    removed = [stored for stored in stored_map.keyframes if is_selected(stored)]
    remaining = [stored for stored in stored_map.keyframes if not is_selected(stored)]
    rows = zip(node_ids, stored_map.keyframes, strict=True)
    changes = forgetting_changes(atlas.forget_keyframes([n for n, stored in rows if is_selected(stored)]))
    with_keyframes = {stored.run_key for stored in remaining}
    named = [run.run_key for run in stored_map.runs if agents is None or run.hello.name in agents]
    empty = [RemoveRun(run) for run in named if run not in with_keyframes]
    poses, loop_count = atlas.all_poses(), len(atlas.graph.edges.loops)
    return ForgettingPlan(tuple(removed), tuple(remaining), loop_count, poses, (*changes, *empty, poses))
