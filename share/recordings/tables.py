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
from share.files.reading import TABLE
from share.recordings.losses import Losses
from share.types import F64, I64

Row = TypeVar("Row", bound=tuple[Any, ...])
MOST_NS = 2**62  # of a stamp, to either side: 146 years, and differences still fit 64 bits
_HEAD = 4096  # bytes in which a binary file shows itself


def read_text(path: Path) -> str:
    """The text of a file. Raises DataError if it is missing, unreadable or binary."""
    try:
        with reading.open_regular(path, TABLE) as file:  # before all of it is in memory
            binary = b"\0" in file.read(_HEAD)
        # spreadsheets begin with a byte-order mark
        text = "" if binary else reading.read_text(path, TABLE, "utf-8-sig")
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; the recording is not complete") from None
    except UnicodeDecodeError:
        raise DataError(f"{path}: is not a text file; the recording is damaged") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    if binary:
        raise DataError(f"{path}: is not a text file; the recording is damaged")
    return text


def rows(
    path: Path, separator: str | None, columns: int, losses: Losses | None = None
) -> Iterator[tuple[int, list[str]]]:
    """(line number, fields) of every line that is not empty or a comment.

    separator: "," or None for white space. A line with fewer than `columns` fields is a DataError, or goes to
    `losses`.
    """
    found = False
    for number, line in _data_lines(path):
        found = True
        fields = [field.strip() for field in line.split(separator)]
        if len(fields) >= columns:
            yield number, fields
            continue
        _lose(losses, path, number, f"{len(fields)} of {columns} columns; the line is cut short, "
              "copy the file again or delete the line")  # fmt: skip
    if not found:
        raise DataError(f"{path}: has no data; the recording is empty or not complete")


def _data_lines(path: Path) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(read_text(path).splitlines(), 1):
        text = line.strip()
        if text and not text.startswith("#"):
            yield number, text


def _lose(losses: Losses | None, path: Path, line: int, why: str) -> None:
    """One line of a table. Raises DataError where nothing may be lost."""
    where = f"{path}, line {line}"
    if losses is None:
        raise DataError(f"{where}: {why}")
    losses.add(f"lines of {path}", where, f"{where}: {why}")


def parsed(
    path: Path,
    separator: str | None,
    columns: int,
    parse: Callable[[list[str], str], Row],
    losses: Losses | None = None,
) -> tuple[I64, list[Row]]:
    """What `parse` makes of each line's fields, in order; its first item is the stamp: stamps (N,) and all.

    A line that it refuses (DataError) and one whose stamp is out of order with most others go to `losses`
    where that is given. Raises DataError where it is not, or more than 5 % are lost.
    """
    found, lines = [], []
    for number, fields in rows(path, separator, columns, losses):
        try:
            found.append(parse(fields, f"{path}, line {number}"))
            lines.append(number)
        except DataError as error:
            _lose(losses, path, number, str(error).removeprefix(f"{path}, line {number}: "))
    stamps = np.array([row[0] for row in found], np.int64)
    good = in_order(path, stamps, lines, losses)
    _check(path, losses, int(good.sum()))
    return stamps[good], [found[i] for i in np.flatnonzero(good)]


def in_order(path: Path, stamps: I64, lines: Sequence[int], losses: Losses | None) -> NDArray[np.bool_]:
    """Which rows (N,) stay if as few as possible are left out so that no stamp is smaller than the one before
    it. Equal ones may pass: the sequencer drops and counts them. Raises DataError where none may be lost."""
    back = np.flatnonzero(stamps[1:] < stamps[:-1])
    if len(back) == 0:
        return np.ones(len(stamps), np.bool_)
    good = longest_rising(stamps)
    for i in [int(back[0]) + 1] if losses is None else np.flatnonzero(~good):
        why = f"stamp {stamps[i]} ns is earlier than the line before or later than those after; sort the file"
        _lose(losses, path, lines[int(i)], f"{why} by its first column")
    return good


def longest_rising(stamps: I64) -> NDArray[np.bool_]:
    """Which (N,) belong to a longest part that never falls (Schensted 1961)."""
    ends: list[int] = []  # smallest last stamp of a part of each length
    at: list[int] = []  # and where it stands
    before = np.full(len(stamps), -1)
    for i, stamp in enumerate(stamps.tolist()):
        k = bisect_right(ends, stamp)
        before[i] = at[k - 1] if k else -1
        ends[k : k + 1] = [stamp]
        at[k : k + 1] = [i]
    out = np.zeros(len(stamps), np.bool_)
    i = at[-1] if at else -1
    while i >= 0:
        out[i] = True
        i = int(before[i])
    return out


def _check(path: Path, losses: Losses | None, good: int) -> None:
    if losses is not None:
        what = f"lines of {path}"
        losses.check(what, good + losses.counts.get(what, 0))


def read_table(path: Path, columns: int, nan: bool = False, losses: Losses | None = None) -> tuple[I64, F64]:
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
    if len(table) == 0 or not finite or (stamps[1:] < stamps[:-1]).any() or not _possible(stamps):
        return _read_slowly(path, columns, nan, losses)
    return stamps, values


def _possible(stamps: I64) -> bool:
    return int(stamps.min()) > -MOST_NS and int(stamps.max()) < MOST_NS


def _read_slowly(path: Path, columns: int, nan: bool, losses: Losses | None) -> tuple[I64, F64]:
    """As `read_table`, line by line: finds what is wrong and says where."""

    def parse(fields: list[str], where: str) -> tuple[int, list[float]]:
        stamp = parse_ns(fields[0], where)
        return stamp, [parse_number(field, where, nan) for field in fields[1:columns]]

    stamps, found = parsed(path, ",", columns, parse, losses)
    return stamps, np.array([values for _, values in found], np.float64).reshape(-1, columns - 1)


def parse_ns(text: str, where: str) -> int:
    """Integer nanoseconds. Exponents and fractions are refused: they have lost digits."""
    try:
        stamp = int(text)
    except ValueError:
        raise DataError(f"{where}: stamp '{text:.40}' is not a whole number of nanoseconds") from None
    return _in_range(stamp, text, where)


def parse_seconds(text: str, where: str) -> int:
    """Decimal seconds, with an exponent or not, to integer nanoseconds without going through a float (digits
    past ns are cut)."""
    if "e" in text.lower():
        return _parse_power(text, where)
    whole, _, fraction = text.partition(".")
    digits = whole.lstrip("+-")
    if not (digits + fraction).isdecimal() or len(digits) > 10:
        raise DataError(f"{where}: stamp '{text:.40}' is not a time in seconds")
    stamp = int(digits or "0") * 10**9 + int((fraction + "000000000")[:9])
    return _in_range(-stamp if whole.startswith("-") else stamp, text, where)


def _parse_power(text: str, where: str) -> int:
    """As `parse_seconds`, of 1.4e+09."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise DataError(f"{where}: stamp '{text:.40}' is not a time in seconds") from None
    if not -(10**10) < seconds < 10**10:  # before it is made whole: 1e999999 has a million digits
        raise DataError(f"{where}: stamp {text:.40} is out of range")
    return _in_range(int(seconds * 10**9), text, where)


def _in_range(stamp_ns: int, text: str, where: str) -> int:
    if abs(stamp_ns) >= MOST_NS:
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
