"""JSON that our own commands write, and read again."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from share.errors import DataError
from share.io.regular_file import REPORT, read_text


def read_json(path: Path) -> dict[str, Any]:
    """One object, the whole file. Raises DataError that names it."""
    return _object(_text(path), str(path))


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """An object a line; the last one may still be being written, and is then left out.

    Raises DataError that names file and line.
    """
    text = _text(path)
    whole = text[: text.rfind("\n") + 1].splitlines()
    return [_object(line, f"{path}, line {number}") for number, line in enumerate(whole, 1)]


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


def _text(path: Path) -> str:
    try:
        return read_text(path, REPORT)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: is damaged: {error}") from None


def _object(text: str, where: str) -> dict[str, Any]:
    try:
        value = json.loads(text)
    except ValueError as error:
        raise DataError(f"{where}: is damaged: {error}") from None
    except RecursionError:
        raise DataError(f"{where}: is damaged: lists in lists without end") from None
    if not isinstance(value, dict):
        raise DataError(f"{where}: is damaged: it is no JSON object")
    return value
