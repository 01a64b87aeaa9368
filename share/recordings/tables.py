"""CSV and TXT tables of a dataset: read by numpy, and when that fails, line by line. A damaged line costs
itself, or is said to be to blame."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from share.errors import DataError
from share.files import reading
from share.files.reading import MAX_TABLE_BYTES
from share.recordings.losses import DataLosses
from share.types import F64, I64

Row = TypeVar("Row", bound=tuple[Any, ...])
MAX_STAMP_NS = 2**62  # of a stamp, to either side: 146 years, and differences still fit 64 bits
_PROBE_BYTES = 4096  # bytes in which a binary file shows itself


def read_text(path: Path) -> str:
    """The text of a file. Raises DataError if it is missing, unreadable or binary."""
    try:
        with reading.open_regular(path, MAX_TABLE_BYTES) as file:  # before all of it is in memory
            binary = b"\0" in file.read(_PROBE_BYTES)
        # spreadsheets begin with a byte-order mark
        text = "" if binary else reading.read_text(path, MAX_TABLE_BYTES, "utf-8-sig")
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; the recording is not complete") from None
    except UnicodeDecodeError:
        raise DataError(f"{path}: is not a text file; the recording is damaged") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    if binary:
        raise DataError(f"{path}: is not a text file; the recording is damaged")
    return text


def read_rows(
    path: Path, separator: str | None, columns: int, losses: DataLosses | None = None
) -> Iterator[tuple[int, list[str]]]:
    """(line number, fields) of every line that is not empty or a comment.

    separator: "," or None for white space. A line with fewer than `columns` fields is a DataError, or goes to
    `losses`.
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
        raise DataError(f"{path}: has no data; the recording is empty or not complete")


def _data_lines(path: Path) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(read_text(path).splitlines(), 1):
        text = line.strip()
        if text and not text.startswith("#"):
            yield number, text


def _count_loss(losses: DataLosses | None, path: Path, line: int, reason: str) -> None:
    """One line of a table. Raises DataError where nothing may be lost."""
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
    """What `parse` makes of each line's fields, in order; its first item is the stamp: stamps (N,) and all.

    A line that it refuses (DataError) and one whose stamp is out of order with most others go to `losses`
    where that is given. Raises DataError where it is not, or more than 5 % are lost.
    """
    parsed_rows, lines = [], []
    for number, fields in read_rows(path, separator, columns, losses):
        try:
            parsed_rows.append(parse(fields, f"{path}, line {number}"))
            lines.append(number)
        except DataError as error:
            _count_loss(losses, path, number, str(error).removeprefix(f"{path}, line {number}: "))
    stamps = np.array([row[0] for row in parsed_rows], np.int64)
    valid = ordered_mask(path, stamps, lines, losses)
    _check_losses(path, losses, int(valid.sum()))
    return stamps[valid], [parsed_rows[i] for i in np.flatnonzero(valid)]


def ordered_mask(
    path: Path, stamps: I64, lines: Sequence[int], losses: DataLosses | None
) -> NDArray[np.bool_]:
    """Which rows (N,) stay if as few as possible are left out so that no stamp is smaller than the one before
    it. Equal ones may pass: the sequencer drops and counts them. Raises DataError where none may be lost."""
    decreasing = np.flatnonzero(stamps[1:] < stamps[:-1])
    if len(decreasing) == 0:
        return np.ones(len(stamps), np.bool_)
    ordered = longest_nondecreasing(stamps)
    for i in [int(decreasing[0]) + 1] if losses is None else np.flatnonzero(~ordered):
        reason = (
            f"stamp {stamps[i]} ns is earlier than the line before or later than those after; sort the file"
        )
        _count_loss(losses, path, lines[int(i)], f"{reason} by its first column")
    return ordered


def longest_nondecreasing(stamps: I64) -> NDArray[np.bool_]:
    """Which (N,) belong to a longest part that never falls (Schensted 1961)."""
    ends: list[int] = []  # smallest last stamp of a part of each length
    ends_at: list[int] = []  # and where it stands
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


def _check_losses(path: Path, losses: DataLosses | None, valid_count: int) -> None:
    if losses is not None:
        kind = f"lines of {path}"
        losses.check(kind, valid_count + losses.counts.get(kind, 0))


def read_table(
    path: Path, columns: int, nan: bool = False, losses: DataLosses | None = None
) -> tuple[I64, F64]:
    """A CSV of integer nanoseconds and numbers: stamps (N,) and the next columns - 1 as (N, columns - 1).

    nan: values may be NaN, or empty. A short line, a stamp or value that is no finite number, and a stamp
    that goes back cost their line and go to `losses`. Raises DataError naming file and line where that is not
    given, or more than 5 % are lost.
    """
    dtype = [("stamp", np.int64), *((f"c{i}", np.float64) for i in range(1, columns))]
    lines = read_text(path).splitlines()
    try:
        if all(not line.strip() or line.startswith("#") for line in lines):
            raise ValueError("empty")
        table = np.loadtxt(lines, dtype, delimiter=",", usecols=range(columns), ndmin=1)
        stamps, values = table["stamp"], np.stack([table[name] for name, _ in dtype[1:]], axis=1)
    except (ValueError, IndexError, OverflowError):
        return _read_slowly(path, columns, nan, losses)
    finite = (np.isfinite(values) | (nan & np.isnan(values))).all()
    if len(table) == 0 or not finite or (stamps[1:] < stamps[:-1]).any() or not _is_in_stamp_range(stamps):
        return _read_slowly(path, columns, nan, losses)
    return stamps, values


def _is_in_stamp_range(stamps: I64) -> bool:
    return int(stamps.min()) > -MAX_STAMP_NS and int(stamps.max()) < MAX_STAMP_NS


def _read_slowly(path: Path, columns: int, nan: bool, losses: DataLosses | None) -> tuple[I64, F64]:
    """As `read_table`, line by line: finds what is wrong and says where."""

    def parse(fields: list[str], where: str) -> tuple[int, list[float]]:
        stamp = parse_ns(fields[0], where)
        return stamp, [parse_number(field, where, nan) for field in fields[1:columns]]

    stamps, parsed_rows = parse_rows(path, ",", columns, parse, losses)
    return stamps, np.array([values for _, values in parsed_rows], np.float64).reshape(-1, columns - 1)


def parse_ns(text: str, where: str) -> int:
    """Integer nanoseconds. Exponents and fractions are refused: they have lost digits."""
    try:
        stamp = int(text)
    except ValueError:
        raise DataError(f"{where}: stamp '{text:.40}' is not a whole number of nanoseconds") from None
    return _checked_stamp(stamp, text, where)


def parse_seconds(text: str, where: str) -> int:
    """Decimal seconds, with an exponent or not, to integer nanoseconds without going through a float (digits
    past ns are cut)."""
    if "e" in text.lower():
        return _parse_exponent_seconds(text, where)
    seconds, _, fraction = text.partition(".")
    digits = seconds.lstrip("+-")
    if not (digits + fraction).isdecimal() or len(digits) > 10:
        raise DataError(f"{where}: stamp '{text:.40}' is not a time in seconds")
    stamp = int(digits or "0") * 10**9 + int((fraction + "000000000")[:9])
    return _checked_stamp(-stamp if seconds.startswith("-") else stamp, text, where)


def _parse_exponent_seconds(text: str, where: str) -> int:
    """As `parse_seconds`, of 1.4e+09."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise DataError(f"{where}: stamp '{text:.40}' is not a time in seconds") from None
    if not -(10**10) < seconds < 10**10:  # before it is made whole: 1e999999 has a million digits
        raise DataError(f"{where}: stamp {text:.40} is out of range")
    return _checked_stamp(int(seconds * 10**9), text, where)


def _checked_stamp(stamp_ns: int, text: str, where: str) -> int:
    if abs(stamp_ns) >= MAX_STAMP_NS:
        raise DataError(f"{where}: stamp {text:.40} is out of range")
    return stamp_ns


def parse_number(text: str, where: str, nan: bool = False) -> float:
    """A finite number; with `nan` also NaN, which nothing is too."""
    if nan and not text:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        raise DataError(f"{where}: '{text:.40}' is not a number") from None
    if not (math.isfinite(value) or (nan and math.isnan(value))):
        raise DataError(f"{where}: '{text:.40}' is not finite")
    return value
