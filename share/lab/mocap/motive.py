"""Read rigid bodies from a CSV export of OptiTrack's Motive (format 1.2 and later).

    Format Version,1.23,Take Name,…,Rotation Type,Quaternion,Length Units,Meters,Coordinate Space,Global

    ,Type,Rigid Body,Rigid Body,…             also markers and bones, which are ignored
    ,Name,Headset1,Headset1,…
    ,ID,"4A…","4A…",…
    ,,Rotation,Rotation,Rotation,Rotation,Position,…
    Frame,Time (Seconds),X,Y,Z,W,X,…
    0,0.000000,0.12,…                         empty cells where a body is not seen

Some versions leave out the words Type, Name, ID, some have a row Parent, some a column of time codes. Source:
docs.optitrack.com, *Data Export: CSV*. The up axis is chosen at the export and not in the file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from share.errors import DataError
from share.lab.mocap import csv_cells
from share.lab.mocap.csv_cells import number_columns
from share.lab.mocap.trajectory import MocapTrajectory
from share.recordings.tables import read_text
from share.recordings.trajectory import make_poses
from share.types import F64, I64

_UNITS = {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3}
_RIGID_BODY = "Rigid Body"
_CELLS = [("Rotation", axis) for axis in "XYZW"] + [("Position", axis) for axis in "XYZ"]


@dataclass(frozen=True, eq=False)
class _MotiveExport:
    """header: of the first line. types, names, kinds (rotation or position), axis_names: a cell per
    column. line: number of the first data row."""

    path: Path
    header: dict[str, str]
    types: list[str]
    names: list[str]
    kinds: list[str]
    axis_names: list[str]
    line: int
    rows: list[list[str]]

    def metres_per_unit(self) -> float:
        """Return the file's unit of length, m."""
        unit = self.header.get("Length Units", "")
        if unit.lower() not in _UNITS:
            known = ", ".join(name.capitalize() for name in _UNITS)
            raise DataError(f"{self.path}, line 1: Length Units '{unit}' are not known; known: {known}")
        return _UNITS[unit.lower()]

    def columns(self) -> dict[str, list[int]]:
        """Return by body the columns of rotation X Y Z W and position X Y Z."""
        bodies = [name for kind, name in zip(self.types, self.names, strict=True) if kind == _RIGID_BODY]
        return {name: [self._column(name, *cell) for cell in _CELLS] for name in dict.fromkeys(bodies)}

    def _column(self, name: str, kind: str, axis: str) -> int:
        headers = zip(self.types, self.names, self.kinds, self.axis_names, strict=True)
        try:
            return list(headers).index((_RIGID_BODY, name, kind, axis))
        except ValueError:
            raise DataError(
                f"{self.path}, line {self.line - 1}: body '{name}' has no column {kind} {axis}; export with "
                "Rotation Type Quaternion"
            ) from None


def is_motive(path: Path) -> bool:
    """Return whether a file begins as Motive's exports do."""
    return read_text(path).lstrip().startswith("Format Version,")


def read_motive(path: Path) -> dict[str, MocapTrajectory | None]:
    """Read each body's poses in the file's axes, None for one that was never seen; stamps are the file's
    times, ns.

    Raises DataError with file and line.
    """
    export = _read_export(path)
    scale, columns = export.metres_per_unit(), export.columns()
    if not columns:
        raise DataError(f"{path}: has no rigid body; export Rigid Bodies, not only markers or skeletons")
    if export.header.get("Coordinate Space", "Global").lower() != "global":
        raise DataError(f"{path}, line 1: Coordinate Space is not Global; export again with Global")
    stamps = _stamps(export)
    return {name: _body_trajectory(export, name, stamps, places, scale) for name, places in columns.items()}


def _read_export(path: Path) -> _MotiveExport:
    rows = csv_cells.cell_rows(read_text(path).splitlines(), path)
    header_row = next((k for k, row in enumerate(rows) if row[:1] == ["Frame"]), 0)
    header_rows = [row for row in rows[1:header_row] if any(row)]
    if len(header_rows) < 3 or header_row + 1 >= len(rows):
        raise DataError(
            f"{path}: expected rows of types, names and IDs, columns that begin with Frame, and data below; "
            "the file is cut short or was exported without its header"
        )
    axes = rows[header_row]
    types, names, kinds = (
        [*row, *[""] * len(axes)][: len(axes)] for row in (header_rows[0], header_rows[1], header_rows[-1])
    )
    header = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    data = [row for row in rows[header_row + 1 :] if any(row)]
    return _MotiveExport(path, header, types, names, kinds, axes, header_row + 2, data)


def _stamps(export: _MotiveExport) -> I64:
    time_column = next((k for k, name in enumerate(export.axis_names) if name.startswith("Time (")), None)
    if time_column is None:
        raise DataError(f"{export.path}, line {export.line - 1}: has no column Time (Seconds); export again")
    seconds = number_columns(export.path, export.line, export.rows, [time_column])[:, 0]
    return csv_cells.stamp_column(seconds, "time", export.path, export.line)


def _body_trajectory(
    export: _MotiveExport, name: str, stamps: I64, columns: list[int], scale: float
) -> MocapTrajectory | None:
    values: F64 = number_columns(export.path, export.line, export.rows, columns)
    is_visible = np.isfinite(values).all(1) & (values[:, :4] != 0).any(1)
    if is_visible.sum() < 2:
        return None
    try:
        return MocapTrajectory(
            stamps[is_visible],
            make_poses(values[is_visible, 4:] * scale, values[is_visible, :4], export.path),
        )
    except DataError as error:
        raise DataError(f"{export.path}: body '{name}': {error}") from None
