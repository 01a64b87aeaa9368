"""Cells of a motion capture's CSV export as numbers."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from share.errors import DataError
from share.types import F64, I64, MAX_STAMP_NS

_MAX_VALUE = 1e15  # in any unit


def cell_rows(lines: Sequence[str], path: Path, line: int = 1, delimiter: str = ",") -> list[list[str]]:
    """Return the stripped cells of a file's lines. line: number of the first. Raises DataError with file
    and line."""
    reader = csv.reader(lines, delimiter=delimiter)
    try:
        return [[cell.strip() for cell in row] for row in reader]
    except csv.Error as error:
        raise DataError(f"{path}, line {line + reader.line_num - 1}: {error}; export again") from None


def number_columns(path: Path, line: int, table: Sequence[Sequence[str]], columns: Sequence[int]) -> F64:
    """Return columns (N, len(columns)) of a table's rows, NaN where a cell is empty or missing. line: of the
    first row.

    A number may have a decimal comma. Raises DataError with file and line.
    """
    cells = [[decimal_point(row[k]) or "nan" if k < len(row) else "nan" for k in columns] for row in table]
    try:
        values = np.array(cells, np.float64).reshape(len(table), len(columns))
        if not (np.abs(values) > _MAX_VALUE).any():
            return values
    except ValueError:
        pass
    for k, row in enumerate(cells):
        for cell in row:
            try:
                is_number = not abs(float(cell)) > _MAX_VALUE
            except ValueError:
                is_number = False
            if not is_number:
                raise DataError(f"{path}, line {line + k}: '{cell:.40}' is not a number; export again")
    raise DataError(f"{path}: cannot be read as numbers; export again")


def decimal_point(number: str) -> str:
    """Return a number's text with a decimal point in place of a comma."""
    return number.strip().replace(",", ".")


def stamp_column(seconds: F64, label: str, path: Path, line: int) -> I64:
    """Return stamps (N,) ns of rows, the first in `line`. label: the column's name in the file.

    Raises DataError with file and line where one is not later than the one before.
    """
    known = np.abs(seconds) < MAX_STAMP_NS * 1e-9
    bad = np.flatnonzero(~known | (np.diff(seconds, prepend=-np.inf) <= 0))
    if len(bad):
        where = f"{path}, line {line + int(bad[0])}"
        raise DataError(f"{where}: its {label} is not later than the one before; export again")
    return np.asarray(np.round(seconds * 1e9), np.int64)
