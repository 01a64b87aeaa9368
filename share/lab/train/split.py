"""Split runs into training, validation, calibration and test by room and motion, never by frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from share.types import I64

PARTS = ("learn", "stop", "calibrate", "test")
_SHARES = (0.6, 0.12, 0.13, 0.15)  # of the groups


def room_groups(abouts: Sequence[Mapping[str, Any]]) -> I64:
    """Return the group (R,) of each of R runs: runs that share a room or a recorded motion are in one."""
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
    """Return the runs of each of `PARTS`: whole groups, drawn by `seed`. No part is empty if there are as
    many groups as parts."""
    names = np.random.default_rng(seed).permutation(np.unique(group))
    min_groups = min(1, len(names) // len(PARTS))
    counts = [max(min_groups, round(share * len(names))) for share in _SHARES[1:]]
    ends = np.cumsum([len(names) - sum(counts), *counts])
    parts = np.split(names, ends[:-1])
    return {part: np.flatnonzero(np.isin(group, mine)) for part, mine in zip(PARTS, parts, strict=True)}


def _room_keys(about: Mapping[str, Any]) -> set[str]:
    """Return the keys that a run shares with others of its group: its room, and its recorded motions."""
    provenance = about["provenance"]
    if "scene" not in provenance:  # a recording, not emulated
        return {f"session {about['session']}"}
    room = f"room {provenance['scene']} {provenance['seed']} {provenance.get('size')}"
    return {room, *(f"motion {motion}" for motion in provenance["motions"] if _is_recorded(motion))}


def _is_recorded(motion: str) -> bool:
    """Return whether a motion is the same in any room (`paper:1`, a recording), not planned in each, as
    `ar=walk:speed=0.6`."""
    name, _, spec = motion.partition("=")
    return not (spec or name).startswith(("walk:", "robot:"))
