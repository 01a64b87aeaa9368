"""Calibration targets: the corners of an AprilGrid or a ChArUco board, and their YAML files.

Frame of every target: on the board, x to the right, y up, z out of the board towards the viewer, m. A
corner's id is its row in `corners`, and the same in every detection.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from share.errors import ConfigError
from share.files.yaml_file import Section, read_yaml
from share.types import F64

DICTIONARIES = ("4X4", "5X5", "6X6", "7X7")  # OpenCV's, each with 50, 100, 250 or 1000 markers
COUNTS = (50, 100, 250, 1000)
APRIL_TAGS = 587  # in the family 36h11


@dataclass(frozen=True)
class AprilGrid:
    """Kalibr's `aprilgrid`: tags of the family 36h11 with a border of two cells, and black squares that touch
    their corners (Furgale et al., IROS 2013; tags: Olson, ICRA 2011).

    tag_size: outer edge of a tag, m. tag_spacing: width of the gap between tags over tag_size. Tag ids count
    from the lower left, along rows, upwards. Origin: the lower left corner of tag 0. Corner ids are 4 tag +
    0, 1, 2, 3 for lower left, lower right, upper right, upper left. Raises ValueError.
    """

    rows: int = 6
    cols: int = 6
    tag_size: float = 0.088
    tag_spacing: float = 0.3

    def __post_init__(self) -> None:
        _positive(self, "rows", "cols", "tag_size", "tag_spacing")
        if self.rows * self.cols > APRIL_TAGS:
            raise ValueError(f"{self.rows} x {self.cols} tags: the family 36h11 has only {APRIL_TAGS}")
        if self.tag_spacing >= 1:
            raise ValueError(f"tag_spacing: {self.tag_spacing:g} must be below 1, a fraction of tag_size")

    @property
    def gap(self) -> float:
        """Gap between tags, and the edge of the black squares, m."""
        return self.tag_size * self.tag_spacing

    @property
    def extent(self) -> F64:
        """Lower left and upper right corner (2, 2) m of the black area."""
        upper = np.array([self.cols, self.rows]) * (self.tag_size + self.gap)
        return np.array([[-self.gap, -self.gap], upper])

    @property
    def tags(self) -> F64:
        """Lower left corner (N, 2) m of each tag."""
        row, column = np.divmod(np.arange(self.rows * self.cols), self.cols)
        return np.stack([column, row], axis=1) * (self.tag_size + self.gap)

    @property
    def corners(self) -> F64:
        """(4 N, 3) m, by id."""
        square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * self.tag_size
        return _on_plane((self.tags[:, None] + square).reshape(-1, 2))


@dataclass(frozen=True)
class CharucoBoard:
    """OpenCV's ChArUco board (pattern of 4.6 and later: the upper left square is black).

    squares_x, squares_y: of the chessboard. square, marker: edges, m. dictionary: OpenCV's name, e.g.
    DICT_5X5_100. Origin: the board's lower left corner. Corner ids are OpenCV's: the inner corners of the
    chessboard from the upper left, along rows, downwards. Raises ValueError.
    """

    squares_x: int = 9
    squares_y: int = 7
    square: float = 0.08
    marker: float = 0.06
    dictionary: str = "DICT_5X5_100"

    def __post_init__(self) -> None:
        _positive(self, "squares_x", "squares_y", "square", "marker")
        if min(self.squares_x, self.squares_y) < 2:
            raise ValueError(f"{self.squares_x} x {self.squares_y} squares have no inner corner")
        if self.marker >= self.square:
            raise ValueError(f"marker: {self.marker:g} m does not fit in a square of {self.square:g} m")
        known = {f"DICT_{bits}_{n}": n for bits in DICTIONARIES for n in COUNTS}
        if self.dictionary not in known:
            raise ValueError(
                f"dictionary: '{self.dictionary}' is not known; one of DICT_4X4_50 .. DICT_7X7_1000"
            )
        if len(self.marker_squares) > known[self.dictionary]:
            raise ValueError(
                f"dictionary: {self.dictionary} is too small for {len(self.marker_squares)} markers"
            )

    @property
    def extent(self) -> F64:
        """Lower left and upper right corner (2, 2) m of the chessboard."""
        return np.array([[0, 0], [self.squares_x * self.square, self.squares_y * self.square]])

    @property
    def marker_squares(self) -> F64:
        """Lower left corner (M, 2) m of the white squares that carry markers, by marker id."""
        return self._squares(1)

    @property
    def black_squares(self) -> F64:
        """Lower left corner (B, 2) m of the black squares."""
        return self._squares(0)

    @property
    def corners(self) -> F64:
        """(N, 3) m, by id."""
        row, column = np.divmod(np.arange((self.squares_x - 1) * (self.squares_y - 1)), self.squares_x - 1)
        return _on_plane(np.stack([column + 1, self.squares_y - 1 - row], axis=1) * self.square)

    def _squares(self, parity: int) -> F64:
        row, column = np.divmod(np.arange(self.squares_x * self.squares_y), self.squares_x)
        chosen = (row + column) % 2 == parity
        lower_left: F64 = np.stack([column, self.squares_y - 1 - row], axis=1)[chosen] * self.square
        return lower_left


Target: TypeAlias = AprilGrid | CharucoBoard


def _on_plane(xy: F64) -> F64:
    return np.column_stack([xy, np.zeros(len(xy))])


def _positive(target: Target, *names: str) -> None:
    for name in names:
        value = getattr(target, name)
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name}: {value:g} must be positive")


# Targets in YAML, with Kalibr's keys; also the `target` of a session.
#
# target_type: aprilgrid          target_type: charuco     (SHARE's: Kalibr has no such target)
# tagCols: 6                      squaresX: 9
# tagRows: 6                      squaresY: 7
# tagSize: 0.088    # m           squareSize: 0.08         # m
# tagSpacing: 0.3                 markerSize: 0.06         # m
#                                 dictionary: DICT_5X5_100

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
_FIRST_TAG = "codeOffset"  # Kalibr's key of an aprilgrid: the number of its first tag
TARGET = "target"  # key of a session.yaml: the target in its room
T_WORLD_TARGET = "T_world_target"  # key beside those of the target in a session.yaml


def read_target(path: Path) -> Target:
    """Read a target file. Raises ConfigError with file and key."""
    return target_from_section(read_yaml(path))


def named_target(name: str) -> Target:
    """Return `aprilgrid` or `charuco` of the usual size, or read a YAML file. Raises ConfigError."""
    if name in _KEYS:
        return _KEYS[name][0]()
    if not Path(name).is_file():
        raise ConfigError(f"--target {name}: no such file; give one, or one of {', '.join(_KEYS)}")
    return read_target(Path(name))


def target_from_section(section: Section) -> Target:
    """Return the target of a YAML mapping. Raises ConfigError with its place and the key."""
    kind = section.text(_TYPE)
    if kind not in _KEYS:
        raise ConfigError(f"{section.where}: {_TYPE}: '{kind}' is not known; known: {', '.join(_KEYS)}")
    cls, names = _KEYS[kind]
    other_keys = (_TYPE, T_WORLD_TARGET, *((_FIRST_TAG,) if cls is AprilGrid else ()))
    if _FIRST_TAG in other_keys and section.number(_FIRST_TAG, 0.0):
        raise ConfigError(
            f"{section.where}: {_FIRST_TAG}: {section.get(_FIRST_TAG)} is not supported; tags must be "
            "numbered from 0, as on a board by `share calibrate target`"
        )
    for key in section.data:
        if key not in names and key not in other_keys:
            near = difflib.get_close_matches(str(key), names, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(names)}"
            raise ConfigError(f"{section.where}: unknown key '{key}'; {hint}")
    values = {name: _value(section, key, name) for key, name in names.items()}
    try:
        return cls(**values)
    except ValueError as error:
        raise ConfigError(f"{section.where}: {error}") from None


def target_mapping(target: Target) -> dict[str, Any]:
    """Return plain data for a YAML file; the inverse of `target_from_section`."""
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
