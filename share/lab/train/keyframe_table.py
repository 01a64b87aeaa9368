"""Keyframes of many runs in one table, for training."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from share.array_table import ArrayTable
from share.errors import UsageError
from share.files.json_file import own_format_errors
from share.lab.train.labels import Labels, read_labels
from share.lab.train.split import room_groups, split_runs
from share.odometry.error_model.inference import MAX_ERROR_CM
from share.odometry.error_model.inputs import INPUT_SHAPES, ErrorModelInput
from share.types import F32, I64, U8

_MIN_CM = 0.01


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
    """abouts: metadata of the R runs. parts: the runs in each of `split.PARTS`."""

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
            f"{folder}: is of {len(np.unique(group))} rooms; to learn, to stop, to calibrate and to test "
            f"takes four at least"
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
    return KeyframeTable(np.concatenate(run), columns[0].clip(_MIN_CM, MAX_ERROR_CM), *columns[1:])
