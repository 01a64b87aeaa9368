"""Read CSV and TXT tables of datasets line by line; a bad line costs itself."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from decimal import ROUND_DOWN, Context, Decimal, InvalidOperation
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from share.checks import MAX_STAMP_NS
from share.errors import DataError
from share.files import reading
from share.files.reading import MAX_TABLE_BYTES, read_errors
from share.recordings.losses import DataLosses
from share.types import F64, I64

Row = TypeVar("Row", bound=tuple[Any, ...])
_TRUNCATING = Context(prec=60, rounding=ROUND_DOWN)
_PROBE_BYTES = 4096  # searched for a NUL, the sign of a binary file


def read_text(path: Path) -> str:
    """Read the text of a file. Raises DataError if it is missing, unreadable or binary."""
    with read_errors(path, missing="no such file; the recording is incomplete"):
        with reading.open_regular(path, MAX_TABLE_BYTES) as file:  # probe before reading all of it
            binary = b"\0" in file.read(_PROBE_BYTES)
        # utf-8-sig: spreadsheets write a byte-order mark
        text = "" if binary else reading.read_text(path, MAX_TABLE_BYTES, "utf-8-sig")
    if binary:
        raise DataError(f"{path}: is not a text file; the recording is damaged")
    return text


def read_rows(
    path: Path, separator: str | None, columns: int, losses: DataLosses | None = None
) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number, fields) of every line that is not empty or a comment.

    separator: "," or None for white space. A line with fewer than `columns` fields goes to `losses`; without
    losses it raises DataError.
    """
    has_data = False
    for number, line in _data_lines(path):
        has_data = True
        fields = [field.strip() for field in line.split(separator)]
        if len(fields) >= columns:
            yield number, fields
            continue
        _count_loss(losses, path, number, f"{len(fields)} of {columns} columns; the line is cut short, "
              "copy the file again or delete the line")  # fmt: skip
    if not has_data:
        raise DataError(f"{path}: has no data; the recording is empty or incomplete")


def _data_lines(path: Path) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(read_text(path).splitlines(), 1):
        text = line.strip()
        if text and not text.startswith("#"):
            yield number, text


def _count_loss(losses: DataLosses | None, path: Path, line: int, reason: str) -> None:
    """Count a bad line. Raises DataError if losses is None."""
    where = f"{path}, line {line}"
    if losses is None:
        raise DataError(f"{where}: {reason}")
    losses.add(f"lines of {path}", where, f"{where}: {reason}")


def parse_rows(
    path: Path,
    separator: str | None,
    columns: int,
    parse: Callable[[list[str], str], Row],
    losses: DataLosses | None = None,
) -> tuple[I64, list[Row]]:
    """Parse the fields of each line; return stamps (N,) and the rows, with the stamp as first item.

    Lines that `parse` refuses (DataError) and lines out of order go to `losses`. Raises DataError if losses
    is None, or more than 5 % are lost.
    """
    parsed_rows, lines = [], []
    for number, fields in read_rows(path, separator, columns, losses):
        try:
            parsed_rows.append(parse(fields, f"{path}, line {number}"))
            lines.append(number)
        except DataError as error:
            _count_loss(losses, path, number, str(error).removeprefix(f"{path}, line {number}: "))
    stamps = np.array([row[0] for row in parsed_rows], np.int64)
    valid = _ordered_mask(path, stamps, lines, losses)
    if losses is not None:
        kind = f"lines of {path}"
        losses.check(kind, int(valid.sum()) + losses.counts.get(kind, 0))
    return stamps[valid], [parsed_rows[i] for i in np.flatnonzero(valid)]


def _ordered_mask(
    path: Path, stamps: I64, lines: Sequence[int], losses: DataLosses | None
) -> NDArray[np.bool_]:
    """Return the largest set of rows (N,) with stamps that never decrease; the others go to `losses`.

    Equal stamps stay: the sequencer drops and counts them. Raises DataError if rows are out of order and
    losses is None.
    """
    decreasing = np.flatnonzero(stamps[1:] < stamps[:-1])
    if len(decreasing) == 0:
        return np.ones(len(stamps), np.bool_)
    ordered = longest_nondecreasing(stamps)
    for i in [int(decreasing[0]) + 1] if losses is None else np.flatnonzero(~ordered):
        reason = f"stamp {stamps[i]} ns is out of order; sort the file by its first column"
        _count_loss(losses, path, lines[int(i)], reason)
    return ordered


def longest_nondecreasing(stamps: I64) -> NDArray[np.bool_]:
    """Return the members (N,) of a longest non-decreasing subsequence (Schensted 1961)."""
    ends: list[int] = []  # smallest last stamp of a subsequence of each length
    ends_at: list[int] = []  # and its index
    before = np.full(len(stamps), -1)
    for i, stamp in enumerate(stamps.tolist()):
        k = bisect_right(ends, stamp)
        before[i] = ends_at[k - 1] if k else -1
        ends[k : k + 1] = [stamp]
        ends_at[k : k + 1] = [i]
    out = np.zeros(len(stamps), np.bool_)
    i = ends_at[-1] if ends_at else -1
    while i >= 0:
        out[i] = True
        i = int(before[i])
    return out


def read_table(
    path: Path, columns: int, nan: bool = False, losses: DataLosses | None = None
) -> tuple[I64, F64]:
    """Read a CSV of integer nanoseconds and numbers; return stamps (N,) and values (N, columns - 1).

    nan: values may be NaN or empty. Lines that are short, out of order, or have a stamp or value that is not
    a finite number go to `losses`. Raises DataError that names file and line if losses is None, or more than
    5 % are lost.
    """

    def parse(fields: list[str], where: str) -> tuple[int, list[float]]:
        return parse_ns(fields[0], where), parse_numbers(fields[1:columns], where, nan)

    stamps, parsed_rows = parse_rows(path, ",", columns, parse, losses)
    return stamps, np.array([values for _, values in parsed_rows], np.float64).reshape(-1, columns - 1)


def parse_ns(text: str, where: str) -> int:
    """Parse integer nanoseconds; exponents and fractions are refused, as they have lost digits."""
    try:
        stamp = int(text)
    except ValueError:
        raise DataError(f"{where}: stamp '{text:.40}' is not a whole number of nanoseconds") from None
    return _checked_stamp(stamp, text, where)


def parse_seconds(text: str, where: str) -> int:
    """Parse decimal seconds, with or without exponent, to integer nanoseconds without floats; truncates."""
    try:
        if "_" in text:  # which Decimal ignores
            raise InvalidOperation
        seconds = Decimal(text)
        in_range = -(10**10) < seconds < 10**10  # check before int(): 1e999999 has a million digits
    except InvalidOperation:
        raise DataError(f"{where}: stamp '{text:.40}' is not a time in seconds") from None
    stamp_ns = int(_TRUNCATING.multiply(seconds, 10**9)) if in_range else MAX_STAMP_NS
    return _checked_stamp(stamp_ns, text, where)


def _checked_stamp(stamp_ns: int, text: str, where: str) -> int:
    if abs(stamp_ns) >= MAX_STAMP_NS:
        raise DataError(f"{where}: stamp {text:.40} is out of range")
    return stamp_ns


def parse_numbers(texts: list[str], where: str, nan: bool = False) -> list[float]:
    """Parse finite numbers. nan: NaN and empty texts are allowed, as NaN."""
    try:
        if math.isfinite(sum(values := [float(text) for text in texts])):
            return values
    except ValueError:
        pass
    return [_parse_number(text, where, nan) for text in texts]


def _parse_number(text: str, where: str, nan: bool = False) -> float:
    """Parse a finite number. nan: NaN and an empty text are allowed, as NaN."""
    if nan and not text:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        raise DataError(f"{where}: '{text:.40}' is not a number") from None
    if not (math.isfinite(value) or (nan and math.isnan(value))):
        raise DataError(f"{where}: '{text:.40}' is not finite")
    return value
