"""Rigid bodies of a CSV export by OptiTrack's Motive (format 1.2 and later).

    Format Version,1.23,Take Name,…,Rotation Type,Quaternion,Length Units,Meters,Coordinate Space,Global

    ,Type,Rigid Body,Rigid Body,…             also markers and bones, which are not read
    ,Name,Headset1,Headset1,…
    ,ID,"4A…","4A…",…
    ,,Rotation,Rotation,Rotation,Rotation,Position,…
    Frame,Time (Seconds),X,Y,Z,W,X,…
    0,0.000000,0.12,…                         empty cells where a body is not seen

Some versions leave the words Type, Name, ID out, some have a row Parent, some a column of time codes.
Source: docs.optitrack.com, *Data Export: CSV*. Which axis is up is chosen at the export and not in the file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from share.errors import DataError
from share.lab.mocap import cells
from share.lab.mocap.cells import numbers
from share.lab.mocap.mocap import Mocap
from share.recordings.tables import read_text
from share.recordings.trajectory import poses
from share.types import F64, I64

_UNITS = {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3}
_BODY = "Rigid Body"
_CELLS = [("Rotation", axis) for axis in "XYZW"] + [("Position", axis) for axis in "XYZ"]


@dataclass(frozen=True, eq=False)
class _Export:
    """about: what the first line says. head: rows of types, names, of rotation or position, and of axes, one
    cell a column. line: of the first row of data."""

    path: Path
    about: dict[str, str]
    types: list[str]
    names: list[str]
    kinds: list[str]
    axes: list[str]
    line: int
    rows: list[list[str]]

    def metres(self) -> float:
        """In one unit of length."""
        unit = self.about.get("Length Units", "")
        if unit.lower() not in _UNITS:
            known = ", ".join(name.capitalize() for name in _UNITS)
            raise DataError(f"{self.path}, line 1: Length Units '{unit}' are not known; known: {known}")
        return _UNITS[unit.lower()]

    def columns(self) -> dict[str, list[int]]:
        """By body, where rotation X Y Z W and position X Y Z are."""
        bodies = [name for kind, name in zip(self.types, self.names, strict=True) if kind == _BODY]
        return {name: [self._column(name, *cell) for cell in _CELLS] for name in dict.fromkeys(bodies)}

    def _column(self, name: str, kind: str, axis: str) -> int:
        found = zip(self.types, self.names, self.kinds, self.axes, strict=True)
        try:
            return list(found).index((_BODY, name, kind, axis))
        except ValueError:
            raise DataError(
                f"{self.path}, line {self.line - 1}: body '{name}' has no column {kind} {axis}; export with "
                "Rotation Type Quaternion"
            ) from None


def is_motive(path: Path) -> bool:
    """Whether it begins as Motive's exports do."""
    return read_text(path).lstrip().startswith("Format Version,")


def read_motive(path: Path) -> dict[str, Mocap | None]:
    """By body, its poses where it was seen, None where it never was, in the axes of the file; stamps are its
    times, ns. Raises DataError naming file and line."""
    export = _read(path)
    scale, columns = export.metres(), export.columns()
    if not columns:
        raise DataError(f"{path}: has no rigid body; export Rigid Bodies, not only markers or skeletons")
    if export.about.get("Coordinate Space", "Global").lower() != "global":
        raise DataError(f"{path}, line 1: Coordinate Space is not Global; export again with Global")
    stamps = _stamps(export)
    return {name: _body(export, name, stamps, places, scale) for name, places in columns.items()}


def _read(path: Path) -> _Export:
    rows = cells.rows(read_text(path).splitlines(), path)
    place = next((k for k, row in enumerate(rows) if row[:1] == ["Frame"]), 0)
    head = [row for row in rows[1:place] if any(row)]
    if len(head) < 3 or place + 1 >= len(rows):
        raise DataError(
            f"{path}: expected rows of types, names and IDs, columns that begin with Frame, and data below; "
            "the file is cut short or was exported without its header"
        )
    axes = rows[place]
    types, names, kinds = ([*row, *[""] * len(axes)][: len(axes)] for row in (head[0], head[1], head[-1]))
    about = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    data = [row for row in rows[place + 1 :] if any(row)]
    return _Export(path, about, types, names, kinds, axes, place + 2, data)


def _stamps(export: _Export) -> I64:
    place = next((k for k, name in enumerate(export.axes) if name.startswith("Time (")), None)
    if place is None:
        raise DataError(f"{export.path}, line {export.line - 1}: has no column Time (Seconds); export again")
    seconds = numbers(export.path, export.line, export.rows, [place])[:, 0]
    return cells.stamps(seconds, "time", export.path, export.line)


def _body(export: _Export, name: str, stamps: I64, places: list[int], scale: float) -> Mocap | None:
    values: F64 = numbers(export.path, export.line, export.rows, places)
    seen = np.isfinite(values).all(1) & (values[:, :4] != 0).any(1)
    if seen.sum() < 2:
        return None
    try:
        return Mocap(stamps[seen], poses(values[seen, 4:] * scale, values[seen, :4], export.path))
    except DataError as error:
        raise DataError(f"{export.path}: body '{name}': {error}") from None
