"""Delete agents' keyframes, or old ones, from a map file for good."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass, replace
from glob import escape
from pathlib import Path
from typing import Any

from share.errors import StoreError, UsageError
from share.mapping.forgetting import ForgettingPlan, plan_forgetting
from share.mapping.map_changes import StoredKeyframe, StoredMap, map_poses
from share.store.map_store import MapStore


@dataclass(frozen=True)
class ForgettingReport:
    """Counts of deleted and remaining items. agents: keyframes by name; maps: keyframes by map; earlier_maps:
    number of maps before. image_bytes: of the deleted images. copies: other files that still hold it all."""

    deleted_keyframes: int
    deleted_agents: dict[str, int]
    deleted_loops: int
    image_bytes: int
    left_keyframes: int
    left_agents: dict[str, int]
    left_loops: int
    left_maps: dict[str, int]
    earlier_maps: int
    copies: tuple[str, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Return plain data."""
        return asdict(self) | {"copies": list(self.copies)}


class Forgetting:
    """A planned deletion in an open map; nothing is changed before `carry_out`."""

    def __init__(self, store: MapStore, agents: Collection[str] | None, before_s: float | None) -> None:
        """agents, before_s: see `plan_forgetting`. Raises UsageError for an unknown agent, StoreError if the
        map cannot be written."""
        if not store.writable:
            raise StoreError(f"{store.path}: nothing can be deleted: {store.read_only_reason}")
        kept = store.load()
        _check_names(store.path, kept, agents)
        self._store, self._plan = store, plan_forgetting(kept, agents, before_s)
        self.report = _report(store, kept, self._plan)

    def carry_out(self) -> None:
        """Delete, and rewrite the file without what was deleted. Raises StoreError if the disk is too full or
        fails."""
        _check_space(self._store.path)
        self._store.write(self._plan.changes)
        self._store.compact()
        copies = tuple(map(str, damaged_copies(self._store.path)))  # a repair makes one
        self.report = replace(self.report, copies=copies)


def _check_space(path: Path) -> None:
    """Raises StoreError where the file cannot be rewritten, which takes its size twice more for a while."""
    need, free = 2 * path.stat().st_size, shutil.disk_usage(path.parent).free
    if need > free:
        raise StoreError(
            f"{path}: nothing was deleted: rewriting it takes {need / 1e6:.0f} MB, "
            f"and {free / 1e6:.0f} MB are free"
        )


def damaged_copies(path: Path) -> list[Path]:
    """Return the damaged files that were kept beside a map."""
    return sorted(path.parent.glob(f"{escape(path.name)}.damaged-*"))


def _check_names(path: Path, kept: StoredMap, agents: Collection[str] | None) -> None:
    known = {run.hello.name for run in kept.runs}
    if unknown := sorted(set(agents or ()) - known):
        listed = ", ".join(sorted(known)) or "none"
        raise UsageError(f"{path}: has no agent '{unknown[0]}'; its agents: {listed}")


def _report(store: MapStore, kept: StoredMap, plan: ForgettingPlan) -> ForgettingReport:
    return ForgettingReport(
        len(plan.removed),
        _count_by_agent(kept, plan.removed),
        len(kept.loops) - plan.loops,
        store.image_bytes(stored.keyframe_key for stored in plan.removed),
        len(plan.remaining),
        _count_by_agent(kept, plan.remaining),
        plan.loops,
        dict(Counter(plan.poses.map_ids)),
        len({name for name, _ in map_poses(kept).values()}),
        tuple(map(str, damaged_copies(store.path))),
    )


def _count_by_agent(kept: StoredMap, keyframes: Iterable[StoredKeyframe]) -> dict[str, int]:
    names = {run.run_key: run.hello.name for run in kept.runs}
    return dict(Counter(names[stored.run_key] for stored in keyframes))
