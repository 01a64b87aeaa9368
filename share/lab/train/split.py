"""Which runs are learnt from and which are kept for the test: by room and motion, never by frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from share.types import I64

PARTS = ("learn", "stop", "calibrate", "test")
_SHARES = (0.6, 0.12, 0.13, 0.15)  # of the groups


def groups(abouts: Sequence[Mapping[str, Any]]) -> I64:
    """(R,) of R runs: those that share a room, or a motion that was recorded, are in one group."""
    found: list[set[str]] = []
    for about in abouts:
        keys = _keys(about)
        together = [group for group in found if group & keys]
        found = [group for group in found if not group & keys] + [keys.union(*together)]
    order = sorted(found, key=min)
    return np.array([next(k for k, group in enumerate(order) if _keys(about) & group) for about in abouts])


def split(group: I64, seed: int) -> dict[str, I64]:
    """Runs (R,) of each of `PARTS`, by whole groups (R,) that are drawn by `seed`; no part is empty where
    there are as many groups as parts."""
    names = np.random.default_rng(seed).permutation(np.unique(group))
    least = min(1, len(names) // len(PARTS))
    counts = [max(least, round(share * len(names))) for share in _SHARES[1:]]
    ends = np.cumsum([len(names) - sum(counts), *counts])
    chosen = np.split(names, ends[:-1])
    return {part: np.flatnonzero(np.isin(group, mine)) for part, mine in zip(PARTS, chosen, strict=True)}


def _keys(about: Mapping[str, Any]) -> set[str]:
    """Its room, and the motions in it that are the same in any room."""
    made = about["provenance"]
    if "scene" not in made:  # recorded, not emulated
        return {f"session {about['session']}"}
    room = f"room {made['scene']} {made['seed']} {made.get('size')}"
    return {room, *(f"motion {motion}" for motion in made["motions"] if _is_recorded(motion))}


def _is_recorded(motion: str) -> bool:
    """`paper:1`, a recording's path; not what is planned anew in each room, as `ar=walk:speed=0.6`."""
    name, _, spec = motion.partition("=")
    return not (spec or name).startswith(("walk:", "robot:"))
