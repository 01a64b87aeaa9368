"""A section of a YAML file to a frozen dataclass: its fields are the keys, its types what they may hold."""

from __future__ import annotations

import dataclasses
import difflib
import types as _types
import typing
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from share.errors import ConfigError
from share.io.section import Section

T = TypeVar("T")


def read(cls: type[T], section: Section) -> T:
    """`section` as the dataclass `cls`, recursively. A key without a field, a missing one without a
    default and a value of another type are a ConfigError naming file and key; so is what `cls` refuses."""
    hints = typing.get_type_hints(cls)
    for key in section.data:
        if key not in hints:
            raise ConfigError(f"{section.where}: unknown key '{key}'{_hint(str(key), list(hints))}")
    values = {}
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        optional = field.default is not dataclasses.MISSING
        if field.name in section or not optional:
            values[field.name] = _value(hints[field.name], section, field.name)
    try:
        return cls(**values)
    except ValueError as error:
        raise ConfigError(f"{section.where}: {error}") from None


def _hint(key: str, known: list[str]) -> str:
    near = difflib.get_close_matches(key, known, n=1)
    return f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(known)}"


def _value(hint: Any, section: Section, key: str) -> Any:
    if isinstance(hint, _types.UnionType):  # X | None
        if section.get(key) is None:
            return None
        hint = next(kind for kind in typing.get_args(hint) if kind is not type(None))
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return read(hint, section.section(key))
    if typing.get_origin(hint) is tuple:
        return _items(typing.get_args(hint), section, key)
    if typing.get_origin(hint) is np.ndarray:
        return section.pose(key)
    return _SCALARS[hint](section, key)


def _items(kinds: tuple[Any, ...], section: Section, key: str) -> tuple[Any, ...]:
    """tuple[X, ...] or tuple[X, X]: a list; each entry is read as if it were a key of its own."""
    data = section.get(key)
    length = None if kinds[-1] is Ellipsis else len(kinds)
    if not isinstance(data, list) or length not in (None, len(data)):
        raise ConfigError(f"{section.where}: {key}: expected a list{f' of {length}' if length else ''}")
    entries = Section({f"{key}[{i}]": entry for i, entry in enumerate(data)}, section.where)
    return tuple(_value(kinds[0], entries, name) for name in entries.data)


def _number(section: Section, key: str) -> float:
    if isinstance(section.get(key), bool):
        raise ConfigError(f"{section.where}: {key}: expected a number, found {section.get(key)}")
    return section.number(key)


def _whole(section: Section, key: str) -> int:
    value = section.get(key)
    if type(value) is not int:
        raise ConfigError(f"{section.where}: {key}: expected a whole number, found {value!r}")
    return value


def _yes_no(section: Section, key: str) -> bool:
    value = section.get(key)
    if type(value) is not bool:
        raise ConfigError(f"{section.where}: {key}: expected true or false, found {value!r}")
    return value


_SCALARS: dict[Any, Callable[[Section, str], Any]] = {
    float: _number,
    int: _whole,
    bool: _yes_no,
    str: lambda section, key: section.text(key),
}
