"""Keyframes of many runs in one table, for those who learn from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from share.columns import Columns
from share.errors import UsageError
from share.files.json_file import as_we_write_it
from share.lab.train.labels import Labels, read_labels
from share.lab.train.split import groups, split
from share.odometry.error_model.features import SHAPES, Features
from share.odometry.error_model.model import MOST_CM
from share.types import F32, I64, U8

_LEAST_CM = 0.01


@dataclass(frozen=True, eq=False)
class Table(Columns):
    """N keyframes whose error is known: run (N,), of which each is; error_cm (N,); picture (N, 128, 128),
    psd (N, 3, 12, 16), scalars (N, 8), recent (N, 14) as in `Features`."""

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
        """(N, 22): scalars and recent."""
        return np.concatenate([self.scalars, self.recent], axis=1)

    def features(self) -> Iterator[Features]:
        """Keyframe by keyframe."""
        columns = [getattr(self, name) for name in SHAPES]
        return (Features(*one) for one in zip(*columns, strict=True))


@dataclass(frozen=True, eq=False)
class Collection:
    """abouts: of its R runs. parts: of `split.PARTS`, the runs in each."""

    abouts: list[dict[str, Any]]
    table: Table
    parts: dict[str, I64]

    def of(self, part: str) -> NDArray[np.bool_]:
        """Which keyframes (N,) of the table are."""
        out: NDArray[np.bool_] = np.isin(self.table.run, self.parts[part])
        return out


def collect(folder: Path, seed: int) -> Collection:
    """All labels in `folder`, split by `seed`. Raises UsageError where there are too few, DataError."""
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise UsageError(f"{folder}: has no labels; make them with `share train labels`")
    found = []
    for path in paths:
        found.append(read_labels(path))
        with as_we_write_it(path):
            groups([found[-1].about])
    abouts = [labels.about for labels in found]
    group = groups(abouts)
    if len(np.unique(group)) < 4:
        raise UsageError(
            f"{folder}: is of {len(np.unique(group))} rooms; to learn, to stop, to calibrate and to test "
            f"takes four at least"
        )
    return Collection(abouts, tabulate(found), split(group, seed))


def tabulate(found: Sequence[Labels]) -> Table:
    """Their keyframes with a known error, errors within a hundredth of a centimetre and 20."""
    known = [np.isfinite(labels.error_cm) for labels in found]
    run = [np.full(int(k.sum()), number) for number, k in enumerate(known)]
    columns = [
        np.concatenate([getattr(labels, name)[k] for labels, k in zip(found, known, strict=True)])
        for name in ("error_cm", *SHAPES)
    ]
    return Table(np.concatenate(run), columns[0].clip(_LEAST_CM, MOST_CM), *columns[1:])
