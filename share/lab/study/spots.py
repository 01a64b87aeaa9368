"""Spots of a study, where a participant calls the robot, and the path that the researcher walks."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import ConfigError, UsageError
from share.files.reading import MAX_SETTINGS_BYTES, read_errors, read_text
from share.plain_data import parse_numbers
from share.types import F64

MAX_SPOTS = 200
_TRIES, _RESTARTS = 100, 20  # per spot; of the whole draw


@dataclass(frozen=True)
class Space:
    """A rectangle of the floor, of width x depth m, with its corner of least x and y at (x, y) m."""

    width: float
    depth: float
    x: float = 0.0
    y: float = 0.0

    def contains(self, points: F64) -> bool:
        """Return whether all points (N, 2), m, lie within."""
        low, size = np.array([self.x, self.y]), np.array([self.width, self.depth])
        return bool(((points >= low) & (points <= low + size)).all())


def draw_spots(space: Space, count: int, margin: float, apart: float, rng: np.random.Generator) -> F64:
    """Return spots (count, 2), m, at least `margin` from the walls and `apart` from each other.

    Raises UsageError if they do not fit.
    """
    size = np.array([space.width, space.depth]) - 2 * margin
    if (size <= 0).any():
        raise UsageError(f"--margin {margin:g}: nothing is left of {space.width:g} x {space.depth:g} m")
    for _ in range(_RESTARTS):
        spots: list[F64] = []
        for _ in range(_TRIES * count):
            spot = np.array([space.x, space.y]) + margin + size * rng.random(2)
            if all(np.hypot(*(spot - one)) >= apart for one in spots):
                spots.append(spot)
                if len(spots) == count:
                    return np.array(spots).round(3)
    raise UsageError(
        f"{count} spots {apart:g} m apart were not found in {size[0]:g} x {size[1]:g} m: "
        "fewer --spots, or less --apart or --margin"
    )


def loop_path(space: Space, margin: float) -> F64:
    """Return a closed path (5, 2), m, around the rectangle, `margin` within it."""
    low = np.array([space.x, space.y]) + margin
    high = np.array([space.x + space.width, space.y + space.depth]) - margin
    return np.array([low, (high[0], low[1]), high, (low[0], high[1]), low]).round(3)


def read_points(path: Path, key: str, least: int, space: Space) -> F64:
    """Read points (N, 2), m: lines `x,y` of a CSV file, or a list of [x, y] under `key` of a YAML file.

    Raises ConfigError, also if one lies outside of the space, or if there are fewer than `least`.
    """
    with read_errors(path, UsageError):
        text = read_text(path, MAX_SETTINGS_BYTES, "utf-8-sig")
    rows = _yaml_rows(text, path, key) if path.suffix in (".yaml", ".yml") else _csv_rows(text)
    if not least <= len(rows) <= MAX_SPOTS:
        raise ConfigError(f"{path}: {len(rows)} points; {least} to {MAX_SPOTS} are wanted")
    points = []
    for number, row in enumerate(rows, 1):
        if not isinstance(row, list) or len(row) != 2:
            raise ConfigError(f"{path}: point {number}: expected x and y, found {row!r:.60}")
        points.append(parse_numbers(row, f"{path}: point {number}"))
        if not space.contains(np.array([points[-1]])):
            raise ConfigError(
                f"{path}: point {number}, {points[-1][0]:g} {points[-1][1]:g}, is outside of the space of "
                f"{space.width:g} x {space.depth:g} m from {space.x:g} {space.y:g}; see --space and --corner"
            )
    return np.array(points)


def _csv_rows(text: str) -> list[Any]:
    rows = [[cell.strip() for cell in row] for row in csv.reader(io.StringIO(text)) if any(row)]
    return rows[1:] if rows and rows[0][:2] == ["x", "y"] else rows


def _yaml_rows(text: str, path: Path, key: str) -> list[Any]:
    from share.files.yaml_file import parse_yaml

    rows = parse_yaml(text, str(path)).get(key)
    if not isinstance(rows, list):
        raise ConfigError(f"{path}: {key}: expected a list of [x, y]")
    return rows
