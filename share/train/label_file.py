"""What a tracker's keyframes looked like and how wrong it was: one file a run, for training.

A NumPy archive (.npz) with a column each and `about`, JSON: of which session and agent, in which room, how it
moved, what was spoiled, and by which SHARE.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import DataError
from share.evaluator.features import PICTURE_PX, Features
from share.evaluator.psd import CHANNELS, GRID
from share.evaluator.scalars import NAMES
from share.io.files import atomic_write
from share.types import F32, I64, U8

SCHEMA = 1


@dataclass(frozen=True, eq=False)
class Labels:
    """Keyframes of one run, in order: stamps_ns (N,); error_cm (N,), NaN unknown; sigma_cm (N,), what the
    tracker says itself; picture (N, 128, 128), psd (N, 3, 12, 16), scalars (N, 8) as in `Features`. about:
    plain data."""

    about: dict[str, Any]
    stamps_ns: I64
    error_cm: F32
    sigma_cm: F32
    picture: U8
    psd: F32
    scalars: F32

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @classmethod
    def of(cls, about: dict[str, Any], rows: Sequence[tuple[int, float, float, Features]]) -> Labels:
        """rows: stamp_ns, error_cm, sigma_cm and features of each keyframe."""
        told = [features for *_, features in rows]
        return cls(
            about,
            np.array([row[0] for row in rows], np.int64),
            np.array([row[1] for row in rows], np.float32),
            np.array([row[2] for row in rows], np.float32),
            np.array([f.picture for f in told], np.uint8).reshape(-1, PICTURE_PX, PICTURE_PX),
            np.array([f.psd for f in told], np.float32).reshape(-1, CHANNELS, GRID[1], GRID[0]),
            np.array([f.scalars for f in told], np.float32).reshape(-1, len(NAMES)),
        )


_COLUMNS = ("stamps_ns", "error_cm", "sigma_cm", "picture", "psd", "scalars")


def write_labels(path: Path, labels: Labels) -> None:
    """Whole or not at all."""
    data = io.BytesIO()
    about = json.dumps({"schema": SCHEMA, **labels.about})
    np.savez_compressed(data, about=np.array(about), **{name: getattr(labels, name) for name in _COLUMNS})
    atomic_write(path, data.getvalue())


def read_labels(path: Path) -> Labels:
    """Raises DataError that names it."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as found:
            about = json.loads(str(found["about"]))
            columns = [found[name] for name in _COLUMNS]
    except Exception as error:  # numpy, zip and json each have their own
        raise DataError(f"{path}: is no file of labels, or damaged: {error}") from None
    if about.pop("schema", None) != SCHEMA:
        raise DataError(f"{path}: is of another schema than {SCHEMA}; make it anew with `share train labels`")
    if len({len(column) for column in columns}) != 1:
        raise DataError(f"{path}: is damaged: its columns differ in length")
    return Labels(about, *columns)
