"""Tables as dataclasses of arrays with one row per item: selection, concatenation and replacement of rows."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from share.types import I64


@dataclass(frozen=True, eq=False)
class ArrayTable:
    """Base class. Every field is an array (N, ...) or an ArrayTable of N rows."""

    def take(self, rows: NDArray[np.bool_] | I64) -> Self:
        """Return these rows, by a mask (N,) or by indices."""
        indices = np.flatnonzero(rows) if rows.dtype == np.bool_ else np.asarray(rows, np.int64)
        return type(self)(*[_take_rows(getattr(self, name), indices) for name in _field_names(type(self))])

    def concatenate(self, *others: Self) -> Self:
        """Return the rows of all tables in order."""
        tables = (self, *others)
        return type(self)(
            *[_concatenate([getattr(t, name) for t in tables]) for name in _field_names(type(self))]
        )

    def put(self, rows: I64, values: Self) -> None:
        """Overwrite these rows with those of `values`, in place."""
        for name in _field_names(type(self)):
            mine, others = getattr(self, name), getattr(values, name)
            if isinstance(mine, ArrayTable):
                mine.put(rows, others)
            else:
                mine[rows] = others


_FIELD_NAMES: dict[type[ArrayTable], tuple[str, ...]] = {}  # cache


def _field_names(table: type[ArrayTable]) -> tuple[str, ...]:
    if table not in _FIELD_NAMES:
        _FIELD_NAMES[table] = tuple(f.name for f in fields(table))
    return _FIELD_NAMES[table]


def _take_rows(value: Any, rows: I64) -> Any:
    return value.take(rows) if isinstance(value, ArrayTable) else value.take(rows, axis=0)


def _concatenate(values: list[Any]) -> Any:
    first = values[0]
    return first.concatenate(*values[1:]) if isinstance(first, ArrayTable) else np.concatenate(values)
