"""Tables as dataclasses of arrays with one row an item: rows chosen, tables put together."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from share.types import I64


@dataclass(frozen=True, eq=False)
class Columns:
    """Every field is an array (N, ...) or Columns of N rows."""

    def take(self, rows: NDArray[np.bool_] | I64) -> Self:
        """These rows, by a mask (N,) or by their numbers."""
        numbers = np.flatnonzero(rows) if rows.dtype == np.bool_ else np.asarray(rows, np.int64)
        return type(self)(*[_rows(getattr(self, name), numbers) for name in _names(type(self))])

    def join(self, *others: Self) -> Self:
        """All rows, one table after the other."""
        tables = (self, *others)
        return type(self)(*[_joined([getattr(t, name) for t in tables]) for name in _names(type(self))])


_NAMES: dict[type[Columns], tuple[str, ...]] = {}  # looked up once


def _names(table: type[Columns]) -> tuple[str, ...]:
    if table not in _NAMES:
        _NAMES[table] = tuple(f.name for f in fields(table))
    return _NAMES[table]


def _rows(value: Any, numbers: I64) -> Any:
    return value.take(numbers) if isinstance(value, Columns) else value.take(numbers, axis=0)


def _joined(values: list[Any]) -> Any:
    first = values[0]
    return first.join(*values[1:]) if isinstance(first, Columns) else np.concatenate(values)
