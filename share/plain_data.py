"""Strict conversion of plain data to frozen dataclasses and back, and strict YAML."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import types
import typing
from typing import Any, TypeVar

from share.errors import ConfigError

T = TypeVar("T")
_MAX_NUMBER = 1e9  # larger than any meaningful setting; the check also rejects NaN and infinity


def from_mapping(cls: type[T], data: Any, where: str) -> T:
    """Return the dataclass `cls` from a mapping, recursively; absent keys take their defaults.

    where: names the source in errors. Raises ConfigError; for an unknown key it names the closest known
    one."""
    if not isinstance(data, dict):
        raise ConfigError(f"{where}: expected a mapping of settings, found {type(data).__name__}")
    hints = typing.get_type_hints(cls)
    values = {}
    for key, value in data.items():
        if key not in hints:
            similar = difflib.get_close_matches(str(key), hints, n=1)
            hint = f"; did you mean '{similar[0]}'?" if similar else f"; known: {', '.join(hints)}"
            raise ConfigError(f"{where}: unknown key '{key}'{hint}")
        values[key] = _convert(hints[key], value, f"{where}: {key}")
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


def _convert(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return from_mapping(hint, value, where)
    if typing.get_origin(hint) is dict and isinstance(value, dict):
        return {str(k): _convert(typing.get_args(hint)[1], v, f"{where}: {k}") for k, v in value.items()}
    accepted = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    if float in accepted and isinstance(value, str):  # PyYAML reads 1e-3 as text
        with contextlib.suppress(ValueError):
            value = float(value)
    if type(value) in (int, float) and not 0 <= value <= _MAX_NUMBER:
        raise ConfigError(f"{where}: expected a number from 0 to {_MAX_NUMBER:g}, found {value}")
    if float in accepted and type(value) is int:
        return float(value)
    for kind in accepted:
        if isinstance(kind, type) and type(value) is kind:
            return value
    names = " or ".join(getattr(kind, "__name__", str(kind)) for kind in accepted)
    raise ConfigError(f"{where}: expected {names}, found {value!r}")


def load_yaml(text: str, where: str) -> Any:
    """Return the data of YAML text, as yaml.safe_load, but with duplicate keys refused and size limits
    (`share.strict_yaml`). Raises ConfigError."""
    import yaml

    from share.strict_yaml import StrictLoader

    try:
        return yaml.load(text, StrictLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        reason = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ConfigError(f"{where}{line}: not valid YAML: {reason}") from None
