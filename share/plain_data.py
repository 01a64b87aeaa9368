"""Strict conversion of plain data (of YAML or JSON) to frozen dataclasses, numbers and poses, and back."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import types
import typing
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from share.checks import checked_pose
from share.errors import ConfigError
from share.types import F64

T = TypeVar("T")
MAX_NUMBER = 1e9  # larger than any meaningful setting; the check also rejects NaN and infinity
_KIND_NAMES = {float: "a number", int: "a whole number", bool: "true or false", str: "a word"}


def from_mapping(cls: type[T], data: Any, where: str, lowest: float = 0.0) -> T:
    """Return the dataclass `cls` from a mapping, recursively: its fields are the keys, with their types.

    A list is a tuple, a 4x4 matrix an array (`parse_pose`); absent keys take their defaults. where: names the
    source in errors. lowest: least number allowed. Raises ConfigError that names the key; for an unknown one
    the closest known one.
    """
    data = checked_mapping(data, where)
    hints = typing.get_type_hints(cls)
    values = {}
    for key, value in data.items():
        if key not in hints:
            similar = difflib.get_close_matches(str(key), hints, n=1)
            hint = f"; did you mean '{similar[0]}'?" if similar else f"; known: {', '.join(hints)}"
            raise ConfigError(f"{where}: unknown key '{key}'{hint}")
        values[key] = _convert(hints[key], value, f"{where}: {key}", lowest)
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        defaults = field.default, field.default_factory
        if field.name not in values and defaults == (dataclasses.MISSING, dataclasses.MISSING):
            raise ConfigError(f"{where}: key '{field.name}' is missing")
    try:
        return cls(**values)
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None


def to_mapping(config: Any) -> dict[str, Any]:
    """Return a configuration as plain data."""
    return dataclasses.asdict(config)


def _convert(hint: Any, value: Any, where: str, lowest: float) -> Any:
    if isinstance(hint, types.UnionType):  # X | None
        if value is None:
            return None
        hint = next(kind for kind in typing.get_args(hint) if kind is not types.NoneType)
    container, items = typing.get_origin(hint), typing.get_args(hint)
    if container is np.ndarray:
        return parse_pose(value, where)
    if container is dict:
        data = checked_mapping(value, where)
        return {str(key): _convert(items[1], one, f"{where}: {key}", lowest) for key, one in data.items()}
    if container is tuple:
        length = None if items[-1] is Ellipsis else len(items)
        if not isinstance(value, list) or length not in (None, len(value)):
            raise ConfigError(f"{where}: expected a list{f' of {length}' if length else ''}")
        return tuple(_convert(items[0], one, f"{where}[{i}]", lowest) for i, one in enumerate(value))
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return from_mapping(hint, value, where, lowest)
    return _convert_scalar(hint, value, where, lowest)


def _convert_scalar(kind: type, value: Any, where: str, lowest: float) -> Any:
    if kind is float and isinstance(value, str):  # PyYAML reads 1e-3 as text
        with contextlib.suppress(ValueError):
            value = float(value)
    if type(value) in (int, float) and not lowest <= value <= MAX_NUMBER:
        raise ConfigError(f"{where}: expected a number from {lowest:g} to {MAX_NUMBER:g}, found {value}")
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        quote = "; put it in quotes" if kind is str and type(value) in (int, float, bool) else ""
        raise ConfigError(f"{where}: expected {_KIND_NAMES[kind]}, found {value!r:.80}{quote}")
    return value


def checked_mapping(data: Any, where: str) -> dict[Any, Any]:
    """Return `data` if it is a mapping. Raises ConfigError."""
    if not isinstance(data, dict):
        raise ConfigError(f"{where}: expected keys and values, found {describe_value(data)}")
    return data


def parse_numbers(values: Sequence[Any], where: str) -> list[float]:
    """Return numbers within ±MAX_NUMBER, which may be given as text. Raises ConfigError."""
    try:
        numbers = [float(value) for value in values]  # PyYAML reads 1e-3 as text
    except (TypeError, ValueError, OverflowError):
        raise ConfigError(f"{where}: expected numbers, found {values}") from None
    if not np.isfinite(numbers).all():
        raise ConfigError(f"{where}: has values that are not finite: {values}")
    if max(map(abs, numbers), default=0.0) > MAX_NUMBER:
        raise ConfigError(f"{where}: has values beyond {MAX_NUMBER:g}: {values}")
    return numbers


def parse_pose(value: Any, where: str) -> F64:
    """Return a rigid transform (4, 4), of rows, 16 numbers, or OpenCV's {rows, cols, data}. Raises
    ConfigError."""
    if isinstance(value, dict):
        value = value.get("data")
    rows = value if isinstance(value, list) else []
    flat = [x for row in rows for x in (row if isinstance(row, list) else [row])]
    if len(flat) != 16:
        raise ConfigError(f"{where}: expected a 4x4 matrix, found {len(flat)} numbers")
    try:
        return checked_pose(where, np.reshape(parse_numbers(flat, where), (4, 4)))
    except ValueError:
        raise ConfigError(
            f"{where}: is not a rigid transform (a rotation and a translation over 0 0 0 1)"
        ) from None


def describe_value(value: Any) -> str:
    """Return kind and value for an error."""
    return "nothing" if value is None else f"{type(value).__name__} {value!r:.40}"
