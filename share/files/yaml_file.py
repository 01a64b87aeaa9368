"""Typed reading of YAML files; every error names the file and the key."""

from __future__ import annotations

import dataclasses
import difflib
import types as _types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from share.config import Config, load_config
from share.errors import ConfigError, UsageError
from share.files.reading import MAX_SETTINGS_BYTES, read_text
from share.plain_data import load_yaml
from share.types import F64, checked_pose


class Section:
    """One mapping of a YAML file. where: file and key. Every reader raises ConfigError that names both."""

    def __init__(self, data: Any, where: str) -> None:
        if not isinstance(data, dict):
            raise ConfigError(f"{where}: expected keys and values, found {_describe_value(data)}")
        self.data: dict[Any, Any] = data
        self.where = where

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def get(self, key: str) -> Any:
        if key not in self.data:
            raise ConfigError(f"{self.where}: key '{key}' is missing")
        return self.data[key]

    def section(self, key: str) -> Section:
        return Section(self.get(key), f"{self.where}: {key}")

    def text(self, key: str, default: str | None = None) -> str:
        value = self.get(key) if default is None else self.data.get(key, default)
        if not isinstance(value, str):
            quoted = "" if value is None or isinstance(value, dict | list) else "; put it in quotes"
            raise ConfigError(f"{self.where}: {key}: expected a word, found {_describe_value(value)}{quoted}")
        return value

    def number(self, key: str, default: float | None = None, positive: bool = False) -> float:
        value = self.get(key) if default is None else self.data.get(key, default)
        number = self._numbers(key, [value])[0]
        if positive and number <= 0:
            raise ConfigError(f"{self.where}: {key}: {value} must be positive")
        return float(number)

    def numbers(self, key: str, lengths: tuple[int, ...]) -> list[float]:
        value = self.get(key)
        if not isinstance(value, list) or len(value) not in lengths:
            count = len(value) if isinstance(value, list) else _describe_value(value)
            raise ConfigError(
                f"{self.where}: {key}: expected {' or '.join(map(str, lengths))} numbers, found {count}"
            )
        return self._numbers(key, value)

    def pose(self, key: str) -> F64:
        """Read a rigid 4x4 transform: rows, 16 numbers, or OpenCV's {rows, cols, data}."""
        value = self.get(key)
        if isinstance(value, dict):
            value = value.get("data")
        rows = value if isinstance(value, list) else []
        flat = [x for row in rows for x in (row if isinstance(row, list) else [row])]
        if len(flat) != 16:
            raise ConfigError(f"{self.where}: {key}: expected a 4x4 matrix, found {len(flat)} numbers")
        try:
            return checked_pose(key, np.reshape(self._numbers(key, flat), (4, 4)))
        except ValueError:
            raise ConfigError(
                f"{self.where}: {key}: is not a rigid transform (a rotation and a translation over 0 0 0 1)"
            ) from None

    def _numbers(self, key: str, values: list[Any]) -> list[float]:
        try:
            numbers = [float(value) for value in values]  # PyYAML reads 1e-3 as text
        except (TypeError, ValueError, OverflowError):
            raise ConfigError(f"{self.where}: {key}: expected numbers, found {values}") from None
        if not np.isfinite(numbers).all():
            raise ConfigError(f"{self.where}: {key}: has values that are not finite: {values}")
        return numbers


def read_yaml_text(path: Path) -> str:
    """Read the text of a YAML file. Raises ConfigError."""
    try:
        return read_text(path, MAX_SETTINGS_BYTES, "utf-8-sig")  # some editors begin with a byte-order mark
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; give the calibration with --calib") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not a text file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None


def read_yaml(path: Path) -> Section:
    """Read the top mapping of a YAML file, including OpenCV's (`%YAML:1.0`, `!!opencv-matrix`). Raises
    ConfigError."""
    text = read_yaml_text(path)
    lines = text.replace("!!opencv-matrix", "").split("\n")
    if lines[0].startswith("%YAML"):  # not valid YAML: the directive needs a space, and a `---` after it
        lines[0] = ""
    return Section(load_yaml("\n".join(lines), str(path)), str(path))


def _describe_value(value: Any) -> str:
    return "nothing" if value is None else f"{type(value).__name__} {value!r:.40}"


# ---- Sections as frozen dataclasses

T = TypeVar("T")


def read_dataclass(cls: type[T], section: Section) -> T:
    """Read `section` as dataclass `cls`, recursively: fields are the keys, their types are checked.

    Raises ConfigError for an unknown key, a missing key without default, a value of another type, and for any
    ValueError of `cls`.
    """
    hints = typing.get_type_hints(cls)
    for key in section.data:
        if key not in hints:
            raise ConfigError(f"{section.where}: unknown key '{key}'{_key_hint(str(key), list(hints))}")
    values = {}
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        optional = field.default is not dataclasses.MISSING
        if field.name in section or not optional:
            values[field.name] = _read_value(hints[field.name], section, field.name)
    try:
        return cls(**values)
    except ValueError as error:
        raise ConfigError(f"{section.where}: {error}") from None


def _key_hint(key: str, known: list[str]) -> str:
    near = difflib.get_close_matches(key, known, n=1)
    return f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(known)}"


def _read_value(hint: Any, section: Section, key: str) -> Any:
    if isinstance(hint, _types.UnionType):  # X | None
        if section.get(key) is None:
            return None
        hint = next(kind for kind in typing.get_args(hint) if kind is not type(None))
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return read_dataclass(hint, section.section(key))
    if typing.get_origin(hint) is tuple:
        return _read_items(typing.get_args(hint), section, key)
    if typing.get_origin(hint) is np.ndarray:
        return section.pose(key)
    return _SCALAR_READERS[hint](section, key)


def _read_items(kinds: tuple[Any, ...], section: Section, key: str) -> tuple[Any, ...]:
    """Read a list as tuple[X, ...] or tuple[X, X]; each entry is read like a key."""
    data = section.get(key)
    length = None if kinds[-1] is Ellipsis else len(kinds)
    if not isinstance(data, list) or length not in (None, len(data)):
        raise ConfigError(f"{section.where}: {key}: expected a list{f' of {length}' if length else ''}")
    entries = Section({f"{key}[{i}]": entry for i, entry in enumerate(data)}, section.where)
    return tuple(_read_value(kinds[0], entries, name) for name in entries.data)


def _read_number(section: Section, key: str) -> float:
    if isinstance(section.get(key), bool):
        raise ConfigError(f"{section.where}: {key}: expected a number, found {section.get(key)}")
    return section.number(key)


def _read_int(section: Section, key: str) -> int:
    value = section.get(key)
    if type(value) is not int:
        raise ConfigError(f"{section.where}: {key}: expected a whole number, found {value!r}")
    return value


def _read_bool(section: Section, key: str) -> bool:
    value = section.get(key)
    if type(value) is not bool:
        raise ConfigError(f"{section.where}: {key}: expected true or false, found {value!r}")
    return value


_SCALAR_READERS: dict[Any, Callable[[Section, str], Any]] = {
    float: _read_number,
    int: _read_int,
    bool: _read_bool,
    str: lambda section, key: section.text(key),
}


def read_settings(path: Path) -> Config:
    """Read a file of settings. Raises ConfigError that names the key and the valid values, UsageError."""
    try:
        text = read_text(path, MAX_SETTINGS_BYTES)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise UsageError(f"{path}: cannot read the configuration: {reason}") from None
    return load_config(text, str(path))
