"""What is in a map file, as plain data: `share dataset info`."""

from __future__ import annotations

from collections import Counter
from typing import Any

from share.core.keeping import Kept, placed
from share.io.map_export import file_names
from share.io.map_store import MapStore
from share.io.sqlite_file import log_of


def describe_map(store: MapStore) -> dict[str, Any]:
    """Agents, maps, loops, size, schema, damage. Raises ShareError."""
    kept = store.load()
    log = log_of(store.path)
    return {
        "name": store.path.name,
        "schema": store.schema,
        "bytes": store.path.stat().st_size + (log.stat().st_size if log.exists() else 0),
        "keyframes": len(kept.keyframes),
        "agents": _agents(kept),
        "maps": dict(Counter(name for name, _ in placed(kept).values())),
        "solved": 0 if kept.poses is None else len(kept.poses.keys),
        "loops": len(kept.loops),
        "damage": list(kept.complaints),
    }


def _agents(kept: Kept) -> dict[str, Any]:
    """By file name of each run, in the order in which they came."""
    held = Counter(k.key for k in kept.keyframes)
    stretches = Counter(name.rpartition("/")[0] for name in kept.stretches)
    names = file_names(kept)
    return {
        names[run.key]: {
            "run": run.key,
            "kind": str(run.hello.kind),
            "keyframes": held[run.key],
            "next_keyframe": kept.next_keyframe[run.key],
            "stretches": stretches[run.key],
        }
        for run in kept.runs
    }
