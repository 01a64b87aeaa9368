"""Read rigid bodies from a CSV export of Vicon's Tracker or Nexus.

    Objects                                   or Segments
    100                                       frames a second
    ,,Ann:Ann,,,,,,Bob:Bob,,,,,               a name above each body's first column
    Frame,Sub Frame,RX,RY,RZ,TX,TY,TZ,RX,…    or RX,RY,RZ,RW with quaternions
    ,,deg,deg,deg,mm,mm,mm,deg,…              units
    1,0,0.12,…                                empty cells where a body is not seen

Other blocks (markers, devices) may precede or follow, separated by an empty line. Cells are separated by
commas or semicolons; with semicolons a number may have a decimal comma.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from share.errors import DataError
from share.geometry import se3
from share.lab.mocap import csv_cells
from share.lab.mocap.csv_cells import decimal_point, number_columns
from share.lab.mocap.trajectory import MocapTrajectory
from share.recordings.tables import read_text
from share.recordings.trajectory import check_position_range, make_poses
from share.types import F64, I64

_BLOCKS = ("Objects", "Segments")
_OTHER_BLOCKS = ("Trajectories", "Model Outputs", "Devices", "Joints")
_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "deg": np.pi / 180, "rad": 1.0}
_HEADER_LINES = 5  # lines of a block before its data


def _rotations_from_xyz(angles: F64) -> F64:
    """Return rotations from angles (N, 3) rad about x, then the new y, then the new z."""
    Rx, Ry, Rz = (se3.so3_exp(angles[:, k : k + 1] * np.eye(3)[k]) for k in range(3))
    return Rx @ Ry @ Rz


ROTATIONS: dict[str, Callable[[F64], F64]] = {"helical": se3.so3_exp, "xyz": _rotations_from_xyz}


@dataclass(frozen=True, eq=False)
class _ViconBlock:
    """Header rows of a block, and its values (N, C), NaN where a cell is empty. line: of its title."""

    path: Path
    line: int
    header_rows: list[list[str]]
    values: F64

    def column(self, start: int, name: str) -> int:
        """Return the column called `name` of the body that begins at column `start`."""
        bodies, named = self.header_rows[2], self.header_rows[3]
        end = next((k for k in range(start + 1, len(bodies)) if bodies[k]), len(named))
        for k in range(start, min(end, len(named))):
            if named[k].upper() == name:
                return k
        raise DataError(
            f"{self.path}, line {self.line + 3}: body '{bodies[start]}' has no column {name}; export "
            "its rotation and its translation"
        )

    def in_si(self, columns: list[int]) -> F64:
        """Return values (N, len(columns)) in m and rad."""
        units = [self.header_rows[4][k].lower() if k < len(self.header_rows[4]) else "" for k in columns]
        for unit in units:
            if unit not in _UNITS:
                known = ", ".join(_UNITS)
                raise DataError(
                    f"{self.path}, line {self.line + 4}: unit '{unit}' is not known; known: {known}"
                )
        return self.values[:, columns] * [_UNITS[unit] for unit in units]


def is_vicon(path: Path) -> bool:
    """Return whether a file's first line with text is the title of a Vicon block."""
    first = next((line for line in read_text(path).splitlines() if line.strip(" ,;")), "")
    return first.strip(" ,;") in (*_BLOCKS, *_OTHER_BLOCKS)


def read_vicon(path: Path, rotations: str = "helical") -> dict[str, MocapTrajectory | None]:
    """Read each body's poses, None for one that was never seen; stamps are frame / rate, ns.

    rotations: convention of three rotation columns, one of ROTATIONS; four are a quaternion. Raises DataError
    with file and line.
    """
    block = _read_block(path)
    stamps = _stamps(block)
    out: dict[str, MocapTrajectory | None] = {}
    for start in [k for k, name in enumerate(block.header_rows[2]) if name and k > 1]:
        T, is_visible = _body_poses(block, start, rotations)
        name = _body_name(block.header_rows[2][start])
        try:
            out[name] = MocapTrajectory(stamps[is_visible], T) if is_visible.sum() >= 2 else None
        except DataError as error:
            raise DataError(f"{path}: body '{name}': {error}") from None
    if all(is_visible is None for is_visible in out.values()):
        raise DataError(f"{path}: no body was ever seen; export the objects that were tracked")
    return out


def _body_name(cell: str) -> str:
    """Return a body's name: `Global Angle Ann:Ann` -> `Ann`. A segment named differently from its subject
    keeps both names."""
    name = cell.strip().removeprefix("Global Angle ").strip()
    subject, _, segment = name.partition(":")
    return subject if segment in ("", subject) else name


def _read_block(path: Path) -> _ViconBlock:
    lines = read_text(path).splitlines()
    titles = [line.strip(" ,;") for line in lines]
    start = next((k for k, title in enumerate(titles) if title in _BLOCKS), None)
    if start is None:
        raise DataError(f"{path}: has no block {' or '.join(_BLOCKS)}; export rigid bodies, not markers")
    end = next((k for k in range(start + _HEADER_LINES, len(titles)) if not titles[k]), len(lines))
    separator = ";" if lines[start + 3 : start + 4] and ";" in lines[start + 3] else ","
    rows = csv_cells.cell_rows(lines[start:end], path, start + 1, separator)
    if len(rows) <= _HEADER_LINES or rows[3][0].lower() != "frame":
        raise DataError(
            f"{path}, line {start + 1}: {titles[start]}: expected a rate, names, columns that begin with "
            "Frame, units and data below it; the file is cut short or of another format"
        )
    values = number_columns(path, start + 1 + _HEADER_LINES, rows[_HEADER_LINES:], range(len(rows[3])))
    return _ViconBlock(path, start + 1, rows[:_HEADER_LINES], values)


def _stamps(block: _ViconBlock) -> I64:
    try:
        rate = float(decimal_point(block.header_rows[1][0]))
    except (ValueError, IndexError):
        rate = 0.0
    if not 1e-3 < rate < 1e5:
        raise DataError(f"{block.path}, line {block.line + 1}: expected the frame rate, Hz")
    return csv_cells.stamp_column(block.values[:, 0] / rate, "frame", block.path, block.line + _HEADER_LINES)


def _body_poses(block: _ViconBlock, start: int, rotations: str) -> tuple[F64, np.ndarray]:
    """Return T (M, 4, 4) where the body is seen, and the mask (N,) of those rows."""
    p = block.in_si([block.column(start, name) for name in ("TX", "TY", "TZ")])
    quaternion = any(name.upper() == "RW" for name in block.header_rows[3])
    names = ("RX", "RY", "RZ", "RW") if quaternion else ("RX", "RY", "RZ")
    columns = [block.column(start, name) for name in names]
    rotations_raw = block.values[:, columns] if quaternion else block.in_si(columns)
    is_not_zero = (p != 0).any(1)  # some versions write zeros where a body is not seen
    is_visible = np.isfinite(p).all(1) & np.isfinite(rotations_raw).all(1) & is_not_zero
    if quaternion:
        return make_poses(p[is_visible], rotations_raw[is_visible], block.path), is_visible
    check_position_range(p[is_visible], block.path)
    return se3.from_rt(ROTATIONS[rotations](rotations_raw[is_visible]), p[is_visible]), is_visible
