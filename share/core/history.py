"""The newest rows of a table of numbers, in little memory."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence


class History:
    """Rows of `columns` numbers, or None; the newest `most` of them. Eight bytes a number, and none before
    it is needed."""

    def __init__(self, columns: int, most: int) -> None:
        self._columns, self._most = columns, most
        self._values = array("d")
        self._next = 0  # row that is written next, once all are taken

    def __len__(self) -> int:
        return len(self._values) // self._columns

    def add(self, row: Sequence[float | None]) -> None:
        """Raises ValueError for another number of columns."""
        if len(row) != self._columns:
            raise ValueError(f"row: {len(row)} numbers instead of {self._columns}")
        values = array("d", [math.nan if value is None else value for value in row])
        if len(self) < self._most:
            self._values.extend(values)
            return
        begin = self._next * self._columns
        self._values[begin : begin + self._columns] = values
        self._next = (self._next + 1) % self._most

    def column(self, k: int) -> list[float | None]:
        """Oldest first."""
        column = self._values[k :: self._columns]
        in_order = column[self._next :] + column[: self._next]
        return [None if math.isnan(value) else value for value in in_order]
