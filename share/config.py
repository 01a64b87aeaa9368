"""Every tunable of SHARE, its unit and its default; and the strict reading of a YAML file of them.

An unknown key is refused by its full name, with the nearest known one. The effective
configuration is written beside the results of every run.
"""

from __future__ import annotations

import dataclasses
import difflib
import types as _types
import typing
from dataclasses import dataclass, field
from typing import Any, TypeVar

from share.errors import ConfigError

T = TypeVar("T")


@dataclass(frozen=True)
class SequencerConfig:
    """How streams are merged by time."""

    sync_tolerance_ms: float = 5.0  # cameras of one frame lie within this
    imu_silent_ms: float = 100.0  # a frame waits this long (stream time) for its IMU samples
    gap_factor: float = 2.5  # a step longer than this many frame intervals is a gap
    max_jump_s: float = 10.0  # a step longer than this is not believed: refused, or a new stretch


@dataclass(frozen=True)
class Config:
    """The whole; one section per part."""

    sequencer: SequencerConfig = field(default_factory=SequencerConfig)


def load(text: str, where: str = "configuration") -> Config:
    """A `Config` from YAML text. Raises ConfigError naming the key and what would be right."""
    import yaml

    try:
        data = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{where}: not valid YAML: {str(error).splitlines()[0]}") from None
    return from_mapping(Config, {} if data is None else data, where)


def from_mapping(cls: type[T], data: Any, where: str) -> T:
    """The dataclass `cls` from a mapping, recursively; absent keys keep their defaults."""
    if not isinstance(data, dict):
        raise ConfigError(f"{where}: expected a mapping of settings, found {type(data).__name__}")
    hints = typing.get_type_hints(cls)
    values = {}
    for key, value in data.items():
        if key not in hints:
            near = difflib.get_close_matches(str(key), hints, n=1)
            hint = f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(hints)}"
            raise ConfigError(f"{where}: unknown key '{key}'{hint}")
        values[key] = _convert(hints[key], value, f"{where}: {key}")
    try:
        return cls(**values)
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None


def to_mapping(config: Any) -> dict[str, Any]:
    """Plain data of a configuration, for a report."""
    return dataclasses.asdict(config)


def _convert(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return from_mapping(hint, value, where)
    accepted = typing.get_args(hint) if isinstance(hint, _types.UnionType) else (hint,)
    if value is None and type(None) in accepted:
        return None
    if float in accepted and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    for kind in accepted:
        if isinstance(kind, type) and type(value) is kind:
            return value
    names = " or ".join(getattr(kind, "__name__", str(kind)) for kind in accepted)
    raise ConfigError(f"{where}: expected {names}, found {value!r}")
