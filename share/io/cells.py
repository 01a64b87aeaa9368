"""The cells of a motion capture's export as numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from share.errors import DataError
from share.types import F64


def numbers(path: Path, line: int, rows: Sequence[Sequence[str]], columns: Sequence[int]) -> F64:
    """Those columns (N, len(columns)) of rows, NaN where a cell is empty or the row ends before it. line: of
    the first row. A number may have a decimal comma. Raises DataError naming file and line."""
    cells = [[point(row[k]) or "nan" if k < len(row) else "nan" for k in columns] for row in rows]
    try:
        return np.array(cells, np.float64).reshape(len(rows), len(columns))
    except ValueError:
        pass
    for k, row in enumerate(cells):
        for cell in row:
            try:
                float(cell)
            except ValueError:
                raise DataError(f"{path}, line {line + k}: '{cell}' is not a number; export again") from None
    raise DataError(f"{path}: cannot be read as numbers; export again")


def point(number: str) -> str:
    """With a decimal point, where some countries' exports have a comma."""
    return number.strip().replace(",", ".")
