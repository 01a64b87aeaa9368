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
from share.evaluator.features import SHAPES, Features, kind_of
from share.io.arrays import read_arrays
from share.io.files import atomic_write
from share.io.json_file import parse_json
from share.types import F32, I64, U8

SCHEMA = 4


@dataclass(frozen=True, eq=False)
class Labels:
    """Keyframes of one run, in order: stamps_ns (N,); error_cm (N,), NaN unknown; picture (N, 128, 128), psd
    (N, 3, 12, 16), scalars (N, 8), recent (N, 14) as in `Features`. about: plain data."""

    about: dict[str, Any]
    stamps_ns: I64
    error_cm: F32
    picture: U8
    psd: F32
    scalars: F32
    recent: F32

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @classmethod
    def of(cls, about: dict[str, Any], rows: Sequence[tuple[int, float, Features]]) -> Labels:
        """rows: stamp_ns, error_cm and features of each keyframe."""
        return cls(
            about,
            np.array([row[0] for row in rows], np.int64),
            np.array([row[1] for row in rows], np.float32),
            *(
                np.array([getattr(row[2], name) for row in rows], kind_of(name)).reshape(-1, *shape)
                for name, shape in SHAPES.items()
            ),
        )


_KINDS: dict[str, tuple[tuple[int, ...], type[np.generic]]] = {
    "stamps_ns": ((), np.int64),
    "error_cm": ((), np.float32),
    **{name: (shape, kind_of(name)) for name, shape in SHAPES.items()},
}
_COLUMNS = tuple(_KINDS)


def write_labels(path: Path, labels: Labels) -> None:
    """Whole or not at all."""
    data = io.BytesIO()
    about = json.dumps({"schema": SCHEMA, **labels.about})
    np.savez_compressed(data, about=np.array(about), **{name: getattr(labels, name) for name in _COLUMNS})
    atomic_write(path, data.getvalue())


def read_labels(path: Path) -> Labels:
    """Raises DataError that names it."""
    found = read_arrays(path, "is no file of labels")
    try:
        about = parse_json(str(found["about"]))
        columns = [found[name] for name in _COLUMNS]
        if about.pop("schema", None) != SCHEMA:
            raise DataError(
                f"{path}: is of another schema than {SCHEMA}; make it anew with `share train labels`"
            )
        count = len(columns[0])
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: is no file of labels, or damaged: {error!r:.200}") from None
    for name, column in zip(_COLUMNS, columns, strict=True):
        shape, kind = _KINDS[name]
        if column.shape != (count, *shape) or column.dtype != kind:
            raise DataError(f"{path}: is damaged: {name} is {column.shape} of {column.dtype}")
    return Labels(about, *columns)
