"""Forgetting: keyframes that leave the map for good, by their age or their agent.

Unlike culling (`share.mapping.culling`), which removes what others resemble, this asks nothing of the rest.
What stays keeps its poses and the loops between its keyframes. What only forgotten keyframes connected
becomes several maps, since no measurement is left that says how these lie to each other; new keyframes join
them again.
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
from share.mapping.query_queue import restored_ranks

DAY_S = 86_400.0


class Retention:
    """When each keyframe of the map came, and which are kept too long. Times are unix s, passed in."""

    def __init__(self, keep_days: float | None) -> None:
        """keep_days: how long keyframes are kept; None: for ever."""
        self._keep_s = None if keep_days is None else keep_days * DAY_S
        self._came_s: dict[int, float | None] = {}

    def add(self, node_id: int, came_s: float | None = None) -> None:
        """Add a keyframe. came_s: when it came; None: now, which is the next call of `expired`."""
        if self._keep_s is not None:
            self._came_s[node_id] = came_s

    def remove(self, node_id: int) -> None:
        self._came_s.pop(node_id, None)

    def expired(self, now_s: float) -> list[int]:
        """Return the keyframes that are to be forgotten by now."""
        if self._keep_s is None:
            return []
        self._came_s = {n: now_s if came_s is None else came_s for n, came_s in self._came_s.items()}
        limit_s = now_s - self._keep_s
        return [n for n, came_s in self._came_s.items() if came_s is not None and came_s <= limit_s]


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

    keyframes: that go. left: those that stay, with `poses`; loops: how many between them. changes: for the
    map file.
    """

    keyframes: tuple[StoredKeyframe, ...]
    left: tuple[StoredKeyframe, ...]
    loops: int
    poses: SavePoses
    changes: tuple[MapChange, ...]


def plan_forgetting(
    kept: StoredMap, agents: Collection[str] | None, before_s: float | None
) -> ForgettingPlan:
    """Plan to forget the keyframes of agents of these names (None: of all) that came before a time (unix s;
    None: whenever they came). Runs of which nothing is left are forgotten with their names.

    A keyframe whose time is unknown counts as new.
    """
    names = {run.run_key: run.hello.name for run in kept.runs}

    def is_selected(stored: StoredKeyframe) -> bool:
        is_old = before_s is None or (stored.came_s is not None and stored.came_s < before_s)
        return is_old and (agents is None or names[stored.run_key] in agents)

    atlas = Atlas(Config().merge)
    for run in kept.runs:
        atlas.add_run(run.run_key, run.hello.name, run.credential)
        atlas.set_present(run.run_key, False)
    node_ids = atlas.restore(kept, restored_ranks(Config(), kept))
    selection = [is_selected(stored) for stored in kept.keyframes]
    removed = atlas.forget_keyframes(
        [n for n, is_removed in zip(node_ids, selection, strict=True) if is_removed]
    )
    left = tuple(
        stored for stored, is_removed in zip(kept.keyframes, selection, strict=True) if not is_removed
    )
    with_keyframes = {stored.run_key for stored in left}
    is_named = [run.run_key for run in kept.runs if agents is None or run.hello.name in agents]
    empty = [RemoveRun(run) for run in is_named if run not in with_keyframes]
    poses = atlas.all_poses()
    return ForgettingPlan(
        tuple(stored for stored, is_removed in zip(kept.keyframes, selection, strict=True) if is_removed),
        left,
        len(atlas.graph.edges.loops),
        poses,
        (*forgetting_changes(removed), *empty, poses),
    )
