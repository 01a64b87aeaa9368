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
        return type(self)(*(_rows(getattr(self, f.name), rows) for f in fields(self)))

    def join(self, *others: Self) -> Self:
        """All rows, one table after the other."""
        return type(self)(*(_joined([getattr(t, f.name) for t in (self, *others)]) for f in fields(self)))


def _rows(value: Any, rows: NDArray[np.bool_] | I64) -> Any:
    return value.take(rows) if isinstance(value, Columns) else value[rows]


def _joined(values: list[Any]) -> Any:
    first = values[0]
    return first.join(*values[1:]) if isinstance(first, Columns) else np.concatenate(values)
