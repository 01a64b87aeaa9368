"""Rigid bodies of a CSV export by Vicon's Tracker or Nexus.

    Objects                                   or Segments
    100                                       frames a second
    ,,Ann:Ann,,,,,,Bob:Bob,,,,,               a name above each body's first column
    Frame,Sub Frame,RX,RY,RZ,TX,TY,TZ,RX,…    or RX,RY,RZ,RW with quaternions
    ,,deg,deg,deg,mm,mm,mm,deg,…              units
    1,0,0.12,…                                empty cells where a body is not seen

Other blocks (markers, devices) may stand before or after, divided by an empty line. Between cells are commas
or semicolons; with these a number may have a decimal comma.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from share.errors import DataError
from share.geometry import se3
from share.lab.mocap import cells
from share.lab.mocap.cells import numbers, point
from share.lab.mocap.mocap import Mocap
from share.recordings.tables import read_text
from share.recordings.trajectory import check_near, poses
from share.types import F64, I64

_BLOCKS = ("Objects", "Segments")
_OTHERS = ("Trajectories", "Model Outputs", "Devices", "Joints")
_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "deg": np.pi / 180, "rad": 1.0}
_HEAD = 5  # lines of a block before its data


def _xyz(angles: F64) -> F64:
    """(N, 3) rad: about x, then the new y, then the new z."""
    Rx, Ry, Rz = (se3.so3_exp(angles[:, k : k + 1] * np.eye(3)[k]) for k in range(3))
    return Rx @ Ry @ Rz


ROTATIONS: dict[str, Callable[[F64], F64]] = {"helical": se3.so3_exp, "xyz": _xyz}


@dataclass(frozen=True, eq=False)
class _Block:
    """The cells of a block's head, and its numbers (N, C), NaN where a cell is empty. line: of its title."""

    path: Path
    line: int
    head: list[list[str]]
    values: F64

    def column(self, start: int, name: str) -> int:
        """Which one is called `name` of those of the body that begins at `start`."""
        bodies, named = self.head[2], self.head[3]
        end = next((k for k in range(start + 1, len(bodies)) if bodies[k]), len(named))
        for k in range(start, min(end, len(named))):
            if named[k].upper() == name:
                return k
        raise DataError(
            f"{self.path}, line {self.line + 3}: body '{bodies[start]}' has no column {name}; export "
            "its rotation and its translation"
        )

    def in_si(self, columns: list[int]) -> F64:
        """Values (N, len(columns)) in m and rad."""
        units = [self.head[4][k].lower() if k < len(self.head[4]) else "" for k in columns]
        for unit in units:
            if unit not in _UNITS:
                known = ", ".join(_UNITS)
                raise DataError(
                    f"{self.path}, line {self.line + 4}: unit '{unit}' is not known; known: {known}"
                )
        return self.values[:, columns] * [_UNITS[unit] for unit in units]


def is_vicon(path: Path) -> bool:
    """Whether its first line with anything in it is the title of a block."""
    first = next((line for line in read_text(path).splitlines() if line.strip(" ,;")), "")
    return first.strip(" ,;") in (*_BLOCKS, *_OTHERS)


def read_vicon(path: Path, rotations: str = "helical") -> dict[str, Mocap | None]:
    """By body, its poses where it was seen, None where it never was; stamps are frame / rate, ns. rotations:
    what three columns of rotation are, one of ROTATIONS; four are a quaternion. Raises DataError naming file
    and line."""
    block = _block(path)
    stamps = _stamps(block)
    out: dict[str, Mocap | None] = {}
    for start in [k for k, name in enumerate(block.head[2]) if name and k > 1]:
        T, seen = _poses(block, start, rotations)
        name = _name(block.head[2][start])
        try:
            out[name] = Mocap(stamps[seen], T) if seen.sum() >= 2 else None
        except DataError as error:
            raise DataError(f"{path}: body '{name}': {error}") from None
    if all(seen is None for seen in out.values()):
        raise DataError(f"{path}: no body was ever seen; export the objects that were tracked")
    return out


def _name(cell: str) -> str:
    """`Global Angle Ann:Ann` -> `Ann`; a segment that is named otherwise than its subject keeps both."""
    name = cell.strip().removeprefix("Global Angle ").strip()
    subject, _, segment = name.partition(":")
    return subject if segment in ("", subject) else name


def _block(path: Path) -> _Block:
    lines = read_text(path).splitlines()
    titles = [line.strip(" ,;") for line in lines]
    start = next((k for k, title in enumerate(titles) if title in _BLOCKS), None)
    if start is None:
        raise DataError(f"{path}: has no block {' or '.join(_BLOCKS)}; export rigid bodies, not markers")
    end = next((k for k in range(start + _HEAD, len(titles)) if not titles[k]), len(lines))
    separator = ";" if lines[start + 3 : start + 4] and ";" in lines[start + 3] else ","
    rows = cells.rows(lines[start:end], path, start + 1, separator)
    if len(rows) <= _HEAD or rows[3][0].lower() != "frame":
        raise DataError(
            f"{path}, line {start + 1}: {titles[start]}: expected a rate, names, columns that begin with "
            "Frame, units and data below it; the file is cut short or of another make"
        )
    values = numbers(path, start + 1 + _HEAD, rows[_HEAD:], range(len(rows[3])))
    return _Block(path, start + 1, rows[:_HEAD], values)


def _stamps(block: _Block) -> I64:
    try:
        rate = float(point(block.head[1][0]))
    except (ValueError, IndexError):
        rate = 0.0
    if not 1e-3 < rate < 1e5:
        raise DataError(f"{block.path}, line {block.line + 1}: expected the frames a second")
    return cells.stamps(block.values[:, 0] / rate, "frame", block.path, block.line + _HEAD)


def _poses(block: _Block, start: int, rotations: str) -> tuple[F64, np.ndarray]:
    """T (M, 4, 4) where the body is seen, and which of the rows (N,) those are."""
    p = block.in_si([block.column(start, name) for name in ("TX", "TY", "TZ")])
    quaternion = any(name.upper() == "RW" for name in block.head[3])
    names = ("RX", "RY", "RZ", "RW") if quaternion else ("RX", "RY", "RZ")
    columns = [block.column(start, name) for name in names]
    turn = block.values[:, columns] if quaternion else block.in_si(columns)
    seen = np.isfinite(p).all(1) & np.isfinite(turn).all(1) & (p != 0).any(1)  # some versions write zeros
    if quaternion:
        return poses(p[seen], turn[seen], block.path), seen
    check_near(p[seen], block.path)
    return se3.compose(ROTATIONS[rotations](turn[seen]), p[seen]), seen
