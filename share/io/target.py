"""Calibration targets in YAML, under Kalibr's names; also the `target` of a session.

target_type: aprilgrid          target_type: charuco     (ours: Kalibr knows none)
tagCols: 6                      squaresX: 9
tagRows: 6                      squaresY: 7
tagSize: 0.088    # m           squareSize: 0.08         # m
tagSpacing: 0.3                 markerSize: 0.06         # m
                                dictionary: DICT_5X5_100
"""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any

from share.errors import ConfigError
from share.geometry.target import AprilGrid, CharucoBoard, Target
from share.io.section import Section, read_yaml
from share.io.session import SESSION
from share.types import F64

_KEYS: dict[str, tuple[type[Target], dict[str, str]]] = {
    "aprilgrid": (
        AprilGrid,
        {"tagRows": "rows", "tagCols": "cols", "tagSize": "tag_size", "tagSpacing": "tag_spacing"},
    ),
    "charuco": (
        CharucoBoard,
        {
            "squaresX": "squares_x",
            "squaresY": "squares_y",
            "squareSize": "square",
            "markerSize": "marker",
            "dictionary": "dictionary",
        },
    ),
}
_TYPE = "target_type"
_FIRST_TAG = "codeOffset"  # Kalibr's, of an aprilgrid: the number of its first tag
TARGET = "target"  # of a session.yaml: the target that stands in its room, and there beside its keys
T_WORLD_TARGET = "T_world_target"


def read_target(path: Path) -> Target:
    """Raises ConfigError naming file and key."""
    return target_of(read_yaml(path))


def named_target(name: str) -> Target:
    """`aprilgrid` or `charuco` of the usual sizes, or a YAML file. Raises ConfigError."""
    if name in _KEYS:
        return _KEYS[name][0]()
    if not Path(name).is_file():
        raise ConfigError(f"--target {name}: no such file, and none of {', '.join(_KEYS)}")
    return read_target(Path(name))


def target_of(section: Section) -> Target:
    """The target of one mapping. Raises ConfigError naming where it stands and the key."""
    kind = section.text(_TYPE)
    if kind not in _KEYS:
        raise ConfigError(f"{section.where}: {_TYPE}: '{kind}' is not known; known: {', '.join(_KEYS)}")
    cls, names = _KEYS[kind]
    beside = (_TYPE, T_WORLD_TARGET, *((_FIRST_TAG,) if cls is AprilGrid else ()))
    if _FIRST_TAG in beside and section.number(_FIRST_TAG, 0.0):
        raise ConfigError(
            f"{section.where}: {_FIRST_TAG}: {section.get(_FIRST_TAG)} is not supported, tags must be "
            "numbered from 0; `share calibrate target` prints such a board"
        )
    for key in section.data:
        if key not in names and key not in beside:
            near = difflib.get_close_matches(str(key), names, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(names)}"
            raise ConfigError(f"{section.where}: unknown key '{key}'; {hint}")
    values = {name: _value(section, key, name) for key, name in names.items()}
    try:
        return cls(**values)
    except ValueError as error:
        raise ConfigError(f"{section.where}: {error}") from None


def session_target(folder: Path) -> tuple[Target, F64] | None:
    """The target in a session's room and T_world_target (4, 4), None where there is none. Raises
    ConfigError naming file and key."""
    top = read_yaml(folder / SESSION)
    if TARGET not in top:
        return None
    section = top.section(TARGET)
    return target_of(section), section.pose(T_WORLD_TARGET)


def to_plain(target: Target) -> dict[str, Any]:
    """As plain data for a YAML file, which `target_of` reads again."""
    kind = next(kind for kind, (cls, _) in _KEYS.items() if isinstance(target, cls))
    return {_TYPE: kind} | {key: getattr(target, name) for key, name in _KEYS[kind][1].items()}


def _value(section: Section, key: str, name: str) -> Any:
    if name == "dictionary":
        return section.text(key)
    if name not in ("rows", "cols", "squares_x", "squares_y"):
        return section.number(key, positive=True)
    value = section.get(key)
    if type(value) is not int or value <= 0:
        raise ConfigError(f"{section.where}: {key}: expected a positive whole number, found {value!r}")
    return value
