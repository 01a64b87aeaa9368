"""Keyframes of many runs in one table, and the split of the runs by room and motion, never by frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from share.array_table import ArrayTable
from share.errors import UsageError
from share.files.json_file import own_format_errors
from share.lab.train.labels import Labels, read_labels
from share.odometry.error_model.inputs import INPUT_SHAPES, ErrorModelInput
from share.odometry.error_model.network import MAX_ERROR_CM
from share.types import F32, I64, U8

MIN_CM = 0.01


@dataclass(frozen=True, eq=False)
class KeyframeTable(ArrayTable):
    """N keyframes with a known error: run (N,), index of its run; error_cm (N,); picture (N, 128, 128), psd
    (N, 3, 12, 16), scalars (N, 8), recent (N, 14) as in `ErrorModelInput`."""

    run: I64
    error_cm: F32
    picture: U8
    psd: F32
    scalars: F32
    recent: F32

    @property
    def log_error(self) -> F32:
        out: F32 = np.log(self.error_cm)
        return out

    @property
    def numbers(self) -> F32:
        """Return (N, 22): scalars and recent."""
        return np.concatenate([self.scalars, self.recent], axis=1)

    def features(self) -> Iterator[ErrorModelInput]:
        """Yield the inputs of each keyframe."""
        columns = [getattr(self, name) for name in INPUT_SHAPES]
        return (ErrorModelInput(*one) for one in zip(*columns, strict=True))


@dataclass(frozen=True, eq=False)
class LabelCollection:
    """abouts: metadata of the R runs. parts: the runs in each of `PARTS`."""

    abouts: list[dict[str, Any]]
    table: KeyframeTable
    parts: dict[str, I64]

    def keyframes_of(self, part: str) -> NDArray[np.bool_]:
        """Return a mask (N,) of the table's keyframes that belong to `part`."""
        out: NDArray[np.bool_] = np.isin(self.table.run, self.parts[part])
        return out


def collect_labels(folder: Path, seed: int) -> LabelCollection:
    """Read all labels in `folder` and split them by `seed`. Raises UsageError where there are too few,
    DataError."""
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise UsageError(f"{folder}: has no labels; make them with `share train labels`")
    all_labels = []
    for path in paths:
        all_labels.append(read_labels(path))
        with own_format_errors(path):
            room_groups([all_labels[-1].about])
    abouts = [labels.about for labels in all_labels]
    group = room_groups(abouts)
    if len(np.unique(group)) < 4:
        raise UsageError(
            f"{folder}: is of {len(np.unique(group))} rooms; to train, validate, calibrate and test "
            "takes at least four"
        )
    return LabelCollection(abouts, tabulate(all_labels), split_runs(group, seed))


def tabulate(all_labels: Sequence[Labels]) -> KeyframeTable:
    """Return the keyframes with a known error, clipped to 0.01 .. 20 cm."""
    is_known = [np.isfinite(labels.error_cm) for labels in all_labels]
    run = [np.full(int(k.sum()), number) for number, k in enumerate(is_known)]
    columns = [
        np.concatenate([getattr(labels, name)[k] for labels, k in zip(all_labels, is_known, strict=True)])
        for name in ("error_cm", *INPUT_SHAPES)
    ]
    return KeyframeTable(np.concatenate(run), columns[0].clip(MIN_CM, MAX_ERROR_CM), *columns[1:])


# The split: runs that share a room or a recorded motion stay together.

PARTS = ("train", "validate", "calibrate", "test")
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
