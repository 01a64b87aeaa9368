"""CSV and TXT tables of a dataset: read by numpy, and when that fails, the line that is to blame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from share.errors import DataError
from share.types import F64, I64


def read_text(path: Path) -> str:
    """The text of a file. Raises DataError if it is missing, unreadable or binary."""
    try:
        return path.read_text(encoding="utf-8-sig")  # spreadsheets and Windows begin with a byte-order mark
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; the recording is not complete") from None
    except UnicodeDecodeError:
        raise DataError(f"{path}: is not a text file; the recording is damaged") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None


def rows(path: Path, separator: str | None, columns: int) -> Iterator[tuple[int, list[str]]]:
    """(line number, fields) of every line that is not empty or a comment.

    separator: "," or None for white space. A line with fewer than `columns` fields is a DataError.
    """
    found = False
    for number, line in enumerate(read_text(path).splitlines(), 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        fields = [field.strip() for field in text.split(separator)]
        if len(fields) < columns:
            raise DataError(
                f"{path}, line {number}: {len(fields)} of {columns} columns; the line is cut short, "
                "copy the file again or delete the line"
            )
        found = True
        yield number, fields
    if not found:
        raise DataError(f"{path}: has no data; the recording is empty or not complete")


def read_table(path: Path, columns: int, nan: bool = False) -> tuple[I64, F64]:
    """A CSV of integer nanoseconds and numbers: stamps (N,) and the next columns - 1 as (N, columns - 1).

    nan: values may be NaN, or empty. Raises DataError naming file and line for a short line, a stamp or value
    that is no finite number, or stamps that go back.
    """
    dtype = [("stamp", np.int64), *((f"c{i}", np.float64) for i in range(1, columns))]
    lines = read_text(path).splitlines()
    try:
        if all(not line.strip() or line.startswith("#") for line in lines):
            raise ValueError("empty")
        table = np.loadtxt(lines, dtype, delimiter=",", usecols=range(columns), ndmin=1)
        values = np.stack([table[name] for name, _ in dtype[1:]], axis=1)
    except (ValueError, IndexError, OverflowError):
        return _read_slowly(path, columns, nan)
    if len(table) == 0 or not (np.isfinite(values) | (nan & np.isnan(values))).all():
        return _read_slowly(path, columns, nan)
    check_sorted(path, table["stamp"])
    return table["stamp"], values


def _read_slowly(path: Path, columns: int, nan: bool) -> tuple[I64, F64]:
    """As `read_table`, line by line: finds what is wrong and says where."""
    stamps, values = [], []
    for number, fields in rows(path, ",", columns):
        stamps.append(parse_ns(fields[0], f"{path}, line {number}"))
        values.append([parse_number(field, f"{path}, line {number}", nan) for field in fields[1:columns]])
    out = np.array(stamps, np.int64)
    check_sorted(path, out)
    return out, np.array(values, np.float64)


def parse_ns(text: str, where: str) -> int:
    """Integer nanoseconds. Exponents and fractions are refused: they have lost digits."""
    try:
        stamp = int(text)
    except ValueError:
        raise DataError(f"{where}: stamp '{text}' is not a whole number of nanoseconds") from None
    return _in_range(stamp, text, where)


def parse_seconds(text: str, where: str) -> int:
    """Decimal seconds, with an exponent or not, to integer nanoseconds without going through a float (digits
    past ns are cut)."""
    if "e" in text.lower():
        return _parse_power(text, where)
    whole, _, fraction = text.partition(".")
    digits = whole.lstrip("+-")
    if not (digits + fraction).isdecimal() or len(digits) > 10:
        raise DataError(f"{where}: stamp '{text}' is not a time in seconds")
    stamp = int(digits or "0") * 10**9 + int((fraction + "000000000")[:9])
    return _in_range(-stamp if whole.startswith("-") else stamp, text, where)


def _parse_power(text: str, where: str) -> int:
    """As `parse_seconds`, of 1.4e+09."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise DataError(f"{where}: stamp '{text}' is not a time in seconds") from None
    if not -(10**10) < seconds < 10**10:  # before it is made whole: 1e999999 has a million digits
        raise DataError(f"{where}: stamp {text} is out of range")
    return _in_range(int(seconds * 10**9), text, where)


def _in_range(stamp_ns: int, text: str, where: str) -> int:
    if abs(stamp_ns) >= 2**63:
        raise DataError(f"{where}: stamp {text} is out of range")
    return stamp_ns


def parse_number(text: str, where: str, nan: bool = False) -> float:
    """A finite number; with `nan` also NaN, which nothing is too."""
    if nan and not text:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        raise DataError(f"{where}: '{text}' is not a number") from None
    if not (math.isfinite(value) or (nan and math.isnan(value))):
        raise DataError(f"{where}: '{text}' is not finite")
    return value


def check_sorted(path: Path, stamps: I64, separator: str | None = ",") -> None:
    """Raises DataError at the first stamp that is smaller than the one before it. Equal ones may pass:
    the sequencer drops and counts them."""
    back = np.flatnonzero(np.diff(stamps) < 0)
    if len(back):
        row = int(back[0]) + 1
        line = next(n for i, (n, _) in enumerate(rows(path, separator, 1)) if i == row)
        raise DataError(
            f"{path}, line {line}: stamp {stamps[row]} ns is earlier than the line before; "
            "sort the file by its first column"
        )
