"""Which runs are learnt from and which are kept for the test: by room and motion, never by frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from share.types import I64

PARTS = ("learn", "stop", "calibrate", "test")
_SHARES = (0.6, 0.12, 0.13, 0.15)  # of the groups


def room_groups(abouts: Sequence[Mapping[str, Any]]) -> I64:
    """(R,) of R runs: those that share a room, or a motion that was recorded, are in one group."""
    merged: list[set[str]] = []
    for about in abouts:
        keys = _room_keys(about)
        overlapping = [group for group in merged if group & keys]
        merged = [group for group in merged if not group & keys] + [keys.union(*overlapping)]
    order = sorted(merged, key=min)
    return np.array(
        [next(k for k, group in enumerate(order) if _room_keys(about) & group) for about in abouts]
    )


def split_runs(group: I64, seed: int) -> dict[str, I64]:
    """Runs (R,) of each of `PARTS`, by whole groups (R,) that are drawn by `seed`; no part is empty where
    there are as many groups as parts."""
    names = np.random.default_rng(seed).permutation(np.unique(group))
    min_groups = min(1, len(names) // len(PARTS))
    counts = [max(min_groups, round(share * len(names))) for share in _SHARES[1:]]
    ends = np.cumsum([len(names) - sum(counts), *counts])
    parts = np.split(names, ends[:-1])
    return {part: np.flatnonzero(np.isin(group, mine)) for part, mine in zip(PARTS, parts, strict=True)}


def _room_keys(about: Mapping[str, Any]) -> set[str]:
    """Its room, and the motions in it that are the same in any room."""
    provenance = about["provenance"]
    if "scene" not in provenance:  # recorded, not emulated
        return {f"session {about['session']}"}
    room = f"room {provenance['scene']} {provenance['seed']} {provenance.get('size')}"
    return {room, *(f"motion {motion}" for motion in provenance["motions"] if _is_recorded(motion))}


def _is_recorded(motion: str) -> bool:
    """`paper:1`, a recording's path; not what is planned anew in each room, as `ar=walk:speed=0.6`."""
    name, _, spec = motion.partition("=")
    return not (spec or name).startswith(("walk:", "robot:"))
