"""Read a motion capture's poses: TUM, CSV of EuRoC and TUM-VI, CSV exports of Vicon and of Motive."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from share.checks import MAX_STAMP_NS
from share.errors import DataError, UsageError
from share.geometry import se3
from share.lab.mocap.trajectory import MocapTrajectory
from share.recordings import tables
from share.recordings.tables import read_text
from share.recordings.trajectory import check_position_range, make_poses, read_tum_table
from share.types import F64, I64

_IDENTITY_POSE = (0, 0, 0, 0, 0, 0, 1)  # x y z qx qy qz qw


def read_mocap(path: Path, allow_unseen: bool = True) -> MocapTrajectory:
    """Read `.csv`: t[ns], x y z, qw qx qy qz, further columns ignored; else TUM: t[s] x y z qx qy qz qw.

    allow_unseen: rows with NaN or a zero quaternion are gaps; else they are errors. Raises UsageError where
    there is no such file, DataError with its name for a damaged one.
    """
    if not path.is_file():
        raise UsageError(f"{path}: no such motion capture file")
    if path.suffix.lower() == ".csv":
        stamps, values = tables.read_table(path, 8, nan=allow_unseen)
        values = values[:, [0, 1, 2, 4, 5, 6, 3]]
    else:
        stamps, values = read_tum_table(path, nan=allow_unseen)
    is_visible = ~np.isnan(values).any(1) & (values[:, 3:] != 0).any(1) | (not allow_unseen)
    if not is_visible.any():
        raise DataError(f"{path}: the body was never seen: all poses are NaN or zero")
    values[~is_visible] = _IDENTITY_POSE  # keeps the row numbers in errors
    try:
        return MocapTrajectory(stamps[is_visible], make_poses(values[:, :3], values[:, 3:], path)[is_visible])
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def read_bodies(path: Path, rotations: str = "helical") -> Mapping[str, MocapTrajectory | None]:
    """Read all rigid bodies of a file by name, None for one that was never seen; "" where the file does not
    name its only body.

    rotations: convention of three rotation columns of Vicon, one of `ROTATIONS`. Raises as `read_mocap`.
    """
    if path.is_file() and path.suffix.lower() == ".csv":
        text = read_text(path)
        first = next((cells for line in text.splitlines() if (cells := line.strip(" ,;"))), "")
        if first in (*_VICON_BLOCKS, *_OTHER_VICON_BLOCKS):
            return _read_vicon(path, text.splitlines(), rotations)
        if first.startswith("Format Version,"):
            return _read_motive(path, text.splitlines())
    return {"": read_mocap(path)}


def pick_body(
    file: str, bodies: Mapping[str, MocapTrajectory | None], body_wanted: str | None, device: str, option: str
) -> tuple[str, MocapTrajectory]:
    """Return name and poses of the body that a device is: the one wanted, else the one of the device's name,
    else the only one.

    option: how a user may name it. Raises UsageError.
    """
    matches = [
        body for body in bodies if body.lower() == (device if body_wanted is None else body_wanted).lower()
    ]
    if not matches and body_wanted is None and len(bodies) == 1:
        matches = list(bodies)
    if matches:
        poses_found = bodies[matches[0]]
        if poses_found is None:
            raise UsageError(
                f"{file}: body '{matches[0]}' is in the file but was never seen; record again with its "
                f"markers in view, or name another ({option})"
            )
        return matches[0], poses_found
    listed = ", ".join(bodies) if any(bodies) else "one without a name"
    missing = f"body for '{device}' (give {option})" if body_wanted is None else f"body '{body_wanted}'"
    raise UsageError(f"{file}: has no {missing}; it has {listed}")


# Exports: tables with rows of headings, and empty cells where a body is not seen.

_MAX_VALUE = 1e15  # in any unit
_MakePoses: TypeAlias = Callable[[F64, F64], F64]


@dataclass(frozen=True, eq=False)
class _Export:
    """A table of an export. headings: rows of cells. rows: of the data, the first in `line` of the file."""

    path: Path
    headings: list[list[str]]
    rows: list[list[str]]
    line: int

    def numbers(self, columns: Sequence[int]) -> F64:
        """Return columns (N, len(columns)), NaN where a cell is empty or missing; a number may have a decimal
        comma. Raises DataError with file and line."""
        out = []
        for k, row in enumerate(self.rows):
            for column in columns:
                cell = row[column] if column < len(row) else ""
                try:
                    out.append(_number(cell or "nan"))
                except ValueError:
                    out.append(np.inf)
                if abs(out[-1]) > _MAX_VALUE:
                    raise self.error(k, f"'{cell:.40}' is not a number; export again")
        return np.array(out).reshape(len(self.rows), len(columns))

    def stamps(self, seconds: F64, label: str) -> I64:
        """Return the stamps (N,) ns of the rows. label: the column's name in the file. Raises DataError where
        one is not later than the one before."""
        known = np.abs(seconds) < MAX_STAMP_NS * 1e-9
        bad = np.flatnonzero(~known | (np.diff(seconds, prepend=-np.inf) <= 0))
        if len(bad):
            raise self.error(int(bad[0]), f"its {label} is not later than the one before; export again")
        return np.asarray(np.round(seconds * 1e9), np.int64)

    def trajectory(
        self, body: str, stamps_ns: I64, is_seen: np.ndarray, p: F64, rotation: F64, make: _MakePoses
    ) -> MocapTrajectory | None:
        """Return the poses that `make` makes of positions and rotations (N, ...) in rows that are known and
        where the body is seen (N,); None of fewer than two."""
        rows = is_seen & np.isfinite(p).all(1) & np.isfinite(rotation).all(1)
        if rows.sum() < 2:
            return None
        try:
            return MocapTrajectory(stamps_ns[rows], make(p[rows], rotation[rows]))
        except DataError as error:
            raise DataError(f"{self.path}: body '{body}': {error}") from None

    def error(self, row: int, text: str) -> DataError:
        """Return an error about a row of data, or of the headings above it (-1 the last)."""
        return DataError(f"{self.path}, line {self.line + row}: {text}")


def _number(cell: str) -> float:
    return float(cell.replace(",", "."))


def _cells(path: Path, lines: Sequence[str], line: int, delimiter: str) -> list[list[str]]:
    """Return the stripped cells of lines, the first of which is number `line`. Raises DataError."""
    reader = csv.reader(lines, delimiter=delimiter)
    try:
        return [[cell.strip() for cell in row] for row in reader]
    except csv.Error as error:
        raise DataError(f"{path}, line {line + reader.line_num - 1}: {error}; export again") from None


# Vicon's Tracker or Nexus:
#
#     Objects                                   or Segments
#     100                                       frames a second
#     ,,Ann:Ann,,,,,,Bob:Bob,,,,,               a name above each body's first column
#     Frame,Sub Frame,RX,RY,RZ,TX,TY,TZ,RX,…    or RX,RY,RZ,RW with quaternions
#     ,,deg,deg,deg,mm,mm,mm,deg,…              units
#     1,0,0.12,…
#
# Other blocks (markers, devices) may precede or follow, separated by an empty line. Cells are separated by
# commas or semicolons.

_VICON_BLOCKS = ("Objects", "Segments")
_OTHER_VICON_BLOCKS = ("Trajectories", "Model Outputs", "Devices", "Joints")
_VICON_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "deg": np.pi / 180, "rad": 1.0}
_VICON_HEADINGS = 5  # lines of a block before its data


def _rotations_from_xyz(angles: F64) -> F64:
    """Return rotations from angles (N, 3) rad about x, then the new y, then the new z."""
    Rx, Ry, Rz = (se3.so3_exp(angles[:, k : k + 1] * np.eye(3)[k]) for k in range(3))
    return Rx @ Ry @ Rz


ROTATIONS: dict[str, Callable[[F64], F64]] = {"helical": se3.so3_exp, "xyz": _rotations_from_xyz}


def _read_vicon(path: Path, lines: Sequence[str], rotations: str) -> dict[str, MocapTrajectory | None]:
    """Read each body's poses; stamps are frame / rate, ns."""
    block = _vicon_block(path, lines)
    try:
        rate = _number(block.headings[1][0])
    except (ValueError, IndexError):
        rate = 0.0
    if not 1e-3 < rate < 1e5:
        raise block.error(-4, "expected the frame rate, Hz")
    stamps = block.stamps(block.numbers([0])[:, 0] / rate, "frame")
    starts = [k for k, name in enumerate(block.headings[2]) if name and k > 1]
    out = {
        _vicon_body_name(block.headings[2][start]): _vicon_body(block, start, end, stamps, rotations)
        for start, end in zip(starts, [*starts[1:], len(block.headings[3])], strict=True)
    }
    if all(trajectory is None for trajectory in out.values()):
        raise DataError(f"{path}: no body was ever seen; export the objects that were tracked")
    return out


def _vicon_block(path: Path, lines: Sequence[str]) -> _Export:
    titles = [line.strip(" ,;") for line in lines]
    start = next((k for k, title in enumerate(titles) if title in _VICON_BLOCKS), None)
    if start is None:
        raise DataError(
            f"{path}: has no block {' or '.join(_VICON_BLOCKS)}; export rigid bodies, not markers"
        )
    end = next((k for k in range(start + _VICON_HEADINGS, len(titles)) if not titles[k]), len(lines))
    separator = ";" if lines[start + 3 : start + 4] and ";" in lines[start + 3] else ","
    rows = _cells(path, lines[start:end], start + 1, separator)
    if len(rows) <= _VICON_HEADINGS or rows[3][0].lower() != "frame":
        raise DataError(
            f"{path}, line {start + 1}: {titles[start]}: expected a rate, names, columns that begin with "
            "Frame, units and data below it; the file is cut short or of another format"
        )
    return _Export(path, rows[:_VICON_HEADINGS], rows[_VICON_HEADINGS:], start + 1 + _VICON_HEADINGS)


def _vicon_body_name(cell: str) -> str:
    """Return a body's name: `Global Angle Ann:Ann` -> `Ann`. A segment named differently from its subject
    keeps both names."""
    name = cell.strip().removeprefix("Global Angle ").strip()
    subject, _, segment = name.partition(":")
    return subject if segment in ("", subject) else name


def _vicon_body(block: _Export, start: int, end: int, stamps: I64, rotations: str) -> MocapTrajectory | None:
    """Return the body of the columns from `start` up to `end`."""
    _, _, bodies, names, units = block.headings
    column_of = {name.upper(): k for k, name in reversed([*enumerate(names)][start:end])}

    def values(*wanted: str, in_si: bool = True) -> F64:
        for name in wanted:
            if name not in column_of:
                text = f"body '{bodies[start]}' has no column {name}; export its rotation and its translation"
                raise block.error(-2, text)
        columns = [column_of[name] for name in wanted]
        columns_units = [units[k].lower() if k < len(units) else "" for k in columns] if in_si else []
        for unit in columns_units:
            if unit not in _VICON_UNITS:
                raise block.error(-1, f"unit '{unit}' is not known; known: {', '.join(_VICON_UNITS)}")
        return block.numbers(columns) * [_VICON_UNITS[unit] for unit in columns_units or ["m"]]

    p = values("TX", "TY", "TZ")
    quaternion = any(name.upper() == "RW" for name in names)
    rotation = values("RX", "RY", "RZ", "RW", in_si=False) if quaternion else values("RX", "RY", "RZ")

    def make(p: F64, rotation: F64) -> F64:
        if quaternion:
            return make_poses(p, rotation, block.path)
        check_position_range(p, block.path)
        return se3.from_rt(ROTATIONS[rotations](rotation), p)

    is_seen = (p != 0).any(1)  # some versions write zeros where a body is not seen
    return block.trajectory(_vicon_body_name(bodies[start]), stamps, is_seen, p, rotation, make)


# OptiTrack's Motive, format 1.2 and later (docs.optitrack.com, *Data Export: CSV*):
#
#     Format Version,1.23,Take Name,…,Rotation Type,Quaternion,Length Units,Meters,Coordinate Space,Global
#
#     ,Type,Rigid Body,Rigid Body,…             also markers and bones, which are ignored
#     ,Name,Headset1,Headset1,…
#     ,ID,"4A…","4A…",…
#     ,,Rotation,Rotation,Rotation,Rotation,Position,…
#     Frame,Time (Seconds),X,Y,Z,W,X,…
#     0,0.000000,0.12,…
#
# Some versions leave out the words Type, Name, ID, some have a row Parent, some a column of time codes. The
# up axis is chosen at the export and not in the file.

_MOTIVE_UNITS = {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3}
_RIGID_BODY = "Rigid Body"
_MOTIVE_CELLS = [("Rotation", axis) for axis in "XYZW"] + [("Position", axis) for axis in "XYZ"]


def _read_motive(path: Path, lines: Sequence[str]) -> dict[str, MocapTrajectory | None]:
    """Read each body's poses in the file's axes; stamps are the file's times, ns."""
    export, header = _motive_export(path, lines)
    unit = header.get("Length Units", "")
    if unit.lower() not in _MOTIVE_UNITS:
        known = ", ".join(name.capitalize() for name in _MOTIVE_UNITS)
        raise DataError(f"{path}, line 1: Length Units '{unit}' are not known; known: {known}")
    columns = [*zip(*export.headings, strict=True)]
    bodies = dict.fromkeys(name for kind, name, _, _ in columns if kind == _RIGID_BODY)
    if not bodies:
        raise DataError(f"{path}: has no rigid body; export Rigid Bodies, not only markers or skeletons")
    if header.get("Coordinate Space", "Global").lower() != "global":
        raise DataError(f"{path}, line 1: Coordinate Space is not Global; export again with Global")
    time = next((k for k, name in enumerate(export.headings[3]) if name.startswith("Time (")), None)
    if time is None:
        raise export.error(-1, "has no column Time (Seconds); export again")
    stamps = export.stamps(export.numbers([time])[:, 0], "time")
    out = {}
    for name in bodies:
        for cell in _MOTIVE_CELLS:
            if (_RIGID_BODY, name, *cell) not in columns:
                text = f"body '{name}' has no column {' '.join(cell)}; export with Rotation Type Quaternion"
                raise export.error(-1, text)
        values = export.numbers([columns.index((_RIGID_BODY, name, *cell)) for cell in _MOTIVE_CELLS])
        q, p = values[:, :4], values[:, 4:] * _MOTIVE_UNITS[unit.lower()]
        is_seen = (q != 0).any(1)
        out[name] = export.trajectory(name, stamps, is_seen, p, q, lambda p, q: make_poses(p, q, path))
    return out


def _motive_export(path: Path, lines: Sequence[str]) -> tuple[_Export, dict[str, str]]:
    """Return the table, with headings types, names, kinds and axes, and the first line's values by name."""
    rows = _cells(path, lines, 1, ",")
    axes_row = next((k for k, row in enumerate(rows) if row[:1] == ["Frame"]), 0)
    headings = [row for row in rows[1:axes_row] if any(row)]
    if len(headings) < 3 or axes_row + 1 >= len(rows):
        raise DataError(
            f"{path}: expected rows of types, names and IDs, columns that begin with Frame, and data below; "
            "the file is cut short or was exported without its header"
        )
    axes = rows[axes_row]
    padded = [[*row, *[""] * len(axes)][: len(axes)] for row in (headings[0], headings[1], headings[-1])]
    data = [row for row in rows[axes_row + 1 :] if any(row)]
    return _Export(path, [*padded, axes], data, axes_row + 2), dict(
        zip(rows[0][::2], rows[0][1::2], strict=False)
    )
