"""Read JSON files that SHARE's own commands wrote."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from share.errors import DataError
from share.files.reading import MAX_EVENTS_BYTES, MAX_REPORT_BYTES, read_errors, read_text


def read_json(path: Path) -> dict[str, Any]:
    """Read a file with one JSON object. Raises DataError that names the file."""
    with read_errors(path):
        text = read_text(path, MAX_REPORT_BYTES)
    return _parse_object(text, str(path))


def read_json_lines(path: Path, max_bytes: int = MAX_EVENTS_BYTES) -> list[dict[str, Any]]:
    """Read a file with one JSON object per line, without an incomplete last line (still being written).

    Raises DataError that names file and line.
    """
    with read_errors(path):
        text = read_text(path, max_bytes)
    complete = text[: text.rfind("\n") + 1].splitlines()
    return [_parse_object(line, f"{path}, line {number}") for number, line in enumerate(complete, 1)]


def parse_json(text: str | bytes) -> Any:
    """Parse JSON strictly: NaN, infinities and numbers beyond float range are errors. Raises ValueError."""
    try:
        return json.loads(
            text, parse_constant=_raise_not_a_number, parse_float=_parse_float, parse_int=_parse_int
        )
    except RecursionError:
        raise ValueError("nested too deeply") from None


@contextlib.contextmanager
def own_format_errors(path: Path) -> Iterator[None]:
    """Within the block, errors from unexpected contents of a file become a DataError that names `path`."""
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, ArithmeticError) as error:
        raise DataError(f"{path}: is damaged, or of another version of SHARE: {error!r:.200}") from None


def nan_to_none(value: Any) -> Any:
    """Return plain data, or arrays, with None for NaN, which JSON lacks, and lists for arrays."""
    match value:
        case float() if math.isnan(value):
            return None
        case dict():
            return {name: nan_to_none(one) for name, one in value.items()}
        case list() | tuple():
            return [nan_to_none(one) for one in value]
        case _ if hasattr(value, "tolist"):  # of numpy, which not all commands import
            return nan_to_none(value.tolist())
        case _:
            return value


def to_plain(value: Any) -> Any:
    """Return value as it would come back from JSON; unknown types become text."""
    return json.loads(json.dumps(value, default=str))


def none_to_nan(row: dict[str, Any]) -> dict[str, Any]:
    """Undo `nan_to_none` on a row of numbers."""
    return {name: math.nan if value is None else value for name, value in row.items()}


def _parse_object(text: str, where: str) -> dict[str, Any]:
    try:
        value = parse_json(text)
    except ValueError as error:
        raise DataError(f"{where}: is damaged: {error}") from None
    if not isinstance(value, dict):
        raise DataError(f"{where}: is damaged: it is not a JSON object")
    return value


def _raise_not_a_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a valid number")


def _parse_float(text: str) -> float:
    if not math.isfinite(value := float(text)):
        _raise_not_a_number(f"{text:.40}")
    return value


def _parse_int(text: str) -> int:
    if len(text) > _MAX_DIGITS:
        _raise_not_a_number(f"{text:.40}")
    return int(text)


_MAX_DIGITS = 40  # more than any stamp or count has; fits a float
