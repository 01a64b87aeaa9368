"""Typed reading of YAML files; every error names the file and the key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from share.config import Config, load_given_config
from share.errors import ConfigError, UsageError
from share.files.reading import MAX_SETTINGS_BYTES, read_errors, read_text
from share.plain_data import checked_mapping, describe_value, parse_numbers, parse_pose
from share.types import F64


class Section:
    """One mapping of a YAML file. where: file and key. Every reader raises ConfigError that names both."""

    def __init__(self, data: Any, where: str) -> None:
        self.data, self.where = checked_mapping(data, where), where

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
            raise ConfigError(f"{self.where}: {key}: expected a word, found {describe_value(value)}{quoted}")
        return value

    def number(self, key: str, default: float | None = None, positive: bool = False) -> float:
        value = self.get(key) if default is None else self.data.get(key, default)
        number = parse_numbers([value], f"{self.where}: {key}")[0]
        if positive and number <= 0:
            raise ConfigError(f"{self.where}: {key}: {value} must be positive")
        return float(number)

    def numbers(self, key: str, lengths: tuple[int, ...]) -> list[float]:
        value = self.get(key)
        if not isinstance(value, list) or len(value) not in lengths:
            count = len(value) if isinstance(value, list) else describe_value(value)
            raise ConfigError(
                f"{self.where}: {key}: expected {' or '.join(map(str, lengths))} numbers, found {count}"
            )
        return parse_numbers(value, f"{self.where}: {key}")

    def pose(self, key: str) -> F64:
        """Read a rigid 4x4 transform (`parse_pose`)."""
        return parse_pose(self.get(key), f"{self.where}: {key}")


def read_yaml_text(path: Path) -> str:
    """Read the text of a YAML file. Raises ConfigError."""
    with read_errors(path, ConfigError, missing="no such file; give the calibration with --calib"):
        return read_text(path, MAX_SETTINGS_BYTES, "utf-8-sig")  # some editors begin with a byte-order mark


def read_yaml(path: Path) -> Section:
    """Read the top mapping of a YAML file, including OpenCV's (`%YAML:1.0`, `!!opencv-matrix`). Raises
    ConfigError."""
    return parse_yaml(read_yaml_text(path), str(path))


def parse_yaml(text: str, where: str) -> Section:
    """Return the top mapping of the text of a YAML file. Raises ConfigError."""
    from share.strict_yaml import load_yaml

    return Section(load_yaml(without_opencv(text), where), where)


def without_opencv(text: str) -> str:
    """Return YAML of OpenCV without what is none, line by line."""
    lines = text.replace("!!opencv-matrix", "").split("\n")
    if lines[0].startswith("%YAML"):  # not valid YAML: the directive needs a space, and a `---` after it
        lines[0] = ""
    return "\n".join(lines)


def read_settings(path: Path) -> Config:
    """Read a file of settings. Raises ConfigError that names the key and the valid values, UsageError."""
    return read_given_settings(path)[0]


def read_given_settings(path: Path) -> tuple[Config, dict[str, Any]]:
    """Read a file of settings; return all settings, and only those that it sets.

    Raises as `read_settings`."""
    with read_errors(path, UsageError):
        text = read_text(path, MAX_SETTINGS_BYTES)
    return load_given_config(text, str(path))
