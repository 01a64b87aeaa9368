"""Trajectories as TUM files: `t[s] x y z qx qy qz qw`, one pose a line.

Stamps go from integer nanoseconds to nine decimals and back without a float between: they are exact.
Poses are rounded to nine decimals; the same trajectory always gives the same bytes.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from share.errors import DataError
from share.geometry import se3
from share.io import tables
from share.types import F64, I64


class Trajectory(NamedTuple):
    """Poses T (N, 4, 4) at stamps_ns (N,), rising."""

    stamps_ns: I64
    T: F64

    @property
    def way(self) -> F64:
        """m (N,), how far it has gone by each pose; [0] without any."""
        steps = np.linalg.norm(np.diff(self.T[:, :3, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def metres(self) -> float:
        """The length of its way."""
        return float(self.way[-1])


def format_pose(stamp_ns: int, T: F64) -> str:
    """One line of a TUM file, without line end; poses to nine decimals (1 nm)."""
    return f"{format_seconds(stamp_ns)} {_format_numbers([*T[:3, 3], *se3.quat_from_matrix(T[:3, :3])])}"


def format_tum(trajectory: Trajectory) -> str:
    """The text of a TUM file."""
    q = se3.quat_from_matrix(trajectory.T[:, :3, :3])
    numbers = np.concatenate([trajectory.T[:, :3, 3], q], axis=1).tolist()
    stamps = map(format_seconds, trajectory.stamps_ns.tolist())
    return "".join(f"{t} {_format_numbers(row)}\n" for t, row in zip(stamps, numbers, strict=True))


def read_tum(path: Path) -> Trajectory:
    """Raises DataError naming file and line."""
    stamps_ns, numbers = read_tum_table(path)
    return Trajectory(stamps_ns, poses(numbers[:, :3], numbers[:, 3:], path))


def read_tum_table(path: Path, nan: bool = False) -> tuple[I64, F64]:
    """Stamps (N,) ns, and x y z qx qy qz qw (N, 7). nan: these may be NaN. Raises DataError likewise."""
    stamps, values = [], []
    for number, fields in tables.rows(path, None, 8):
        where = f"{path}, line {number}"
        stamps.append(tables.parse_seconds(fields[0], where))
        values.append([tables.parse_number(field, where, nan) for field in fields[1:8]])
    stamps_ns = np.array(stamps, np.int64)
    tables.check_sorted(path, stamps_ns, None)
    return stamps_ns, np.array(values)


def poses(p: F64, q: F64, path: Path) -> F64:
    """(N, 3) m and quaternions (N, 4) xyzw -> (N, 4, 4). DataError where a quaternion is no rotation."""
    norm = np.linalg.norm(q, axis=1)
    bad = np.flatnonzero(np.abs(norm - 1) > 0.05)
    if len(bad):
        raise DataError(f"{path}: pose {bad[0] + 1}: quaternion has length {norm[bad[0]]:.3g}, expected 1")
    return se3.from_quat(p, q)


def format_seconds(stamp_ns: int) -> str:
    """Integer nanoseconds as decimal seconds with nine decimals."""
    whole, fraction = divmod(abs(stamp_ns), 10**9)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{fraction:09d}"


def _format_numbers(values: list[float]) -> str:
    return " ".join(f"{value + 0.0:.9f}" for value in np.round(values, 9).tolist())  # + 0.0: never -0
