"""JSON that our own commands write, and read again."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from share.errors import DataError
from share.files.reading import EVENTS, REPORT, read_text


def read_json(path: Path) -> dict[str, Any]:
    """One object, the whole file. Raises DataError that names it."""
    return _object(_text(path, REPORT), str(path))


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """An object a line; the last one may still be being written, and is then left out.

    Raises DataError that names file and line.
    """
    text = _text(path, EVENTS)
    whole = text[: text.rfind("\n") + 1].splitlines()
    return [_object(line, f"{path}, line {number}") for number, line in enumerate(whole, 1)]


def parse_json(text: str | bytes) -> Any:
    """As json.loads; a number that is none, or beyond what a float holds, is refused. Raises ValueError."""
    try:
        return json.loads(text, parse_constant=_no_number, parse_float=_float, parse_int=_int)
    except RecursionError:
        raise ValueError("lists in lists without end") from None


@contextlib.contextmanager
def as_we_write_it(path: Path) -> Iterator[None]:
    """What a file of ours holds is taken for what it should be: errors that come of its being something else
    become a DataError that names `path`."""
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, ArithmeticError) as error:
        raise DataError(f"{path}: is damaged, or by another SHARE: {error!r:.200}") from None


def known(value: Any) -> Any:
    """Plain data for JSON, which knows no NaN: None in its place."""
    match value:
        case float() if math.isnan(value):
            return None
        case dict():
            return {name: known(one) for name, one in value.items()}
        case list() | tuple():
            return [known(one) for one in value]
        case _:
            return value


def plain(value: Any) -> Any:
    """As it comes back from JSON, in which what that does not know is text."""
    return json.loads(json.dumps(value, default=str))


def with_nan(row: dict[str, Any]) -> dict[str, Any]:
    """What `known` made of a row of numbers, as it was."""
    return {name: math.nan if value is None else value for name, value in row.items()}


def _text(path: Path, most: int) -> str:
    try:
        return read_text(path, most)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: is damaged: {error}") from None


def _object(text: str, where: str) -> dict[str, Any]:
    try:
        value = parse_json(text)
    except ValueError as error:
        raise DataError(f"{where}: is damaged: {error}") from None
    if not isinstance(value, dict):
        raise DataError(f"{where}: is damaged: it is no JSON object")
    return value


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number")


def _float(text: str) -> float:
    if not math.isfinite(value := float(text)):
        _no_number(f"{text:.40}")
    return value


def _int(text: str) -> int:
    if len(text) > _DIGITS:
        _no_number(f"{text:.40}")
    return int(text)


_DIGITS = 40  # more than any stamp or count has, and a float holds it
