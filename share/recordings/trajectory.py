"""Read and write trajectories as TUM files: `t[s] x y z qx qy qz qw`, one pose per line.

Stamps are exact: integer nanoseconds are written as nine decimals and read back without floats. Poses are
rounded to nine decimals. Deterministic: equal trajectories give equal bytes.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from share.errors import DataError
from share.geometry import se3
from share.recordings import tables
from share.recordings.losses import DataLosses
from share.types import F64, I64

MAX_POSITION_M = 1e7  # from the origin; satellite ground truth counts from the centre of the earth
_MAX_NORM_ERROR = 0.05  # of a quaternion: |norm - 1|


class Trajectory(NamedTuple):
    """Poses T (N, 4, 4) at stamps_ns (N,), which do not decrease."""

    stamps_ns: I64
    T: F64

    @property
    def travelled_m(self) -> F64:
        """Distance travelled until each pose (N,), m; [0] without poses."""
        steps = np.linalg.norm(np.diff(self.T[:, :3, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def length_m(self) -> float:
        """Length of the path, m."""
        return float(self.travelled_m[-1])


def format_pose(stamp_ns: int, T: F64) -> str:
    """Return one line of a TUM file, without line end; nine decimals (1 nm)."""
    return f"{format_seconds(stamp_ns)} {_format_numbers([*T[:3, 3], *se3.quat_from_matrix(T[:3, :3])])}"


def format_tum(trajectory: Trajectory) -> str:
    """Return the text of a TUM file."""
    q = se3.quat_from_matrix(trajectory.T[:, :3, :3])
    numbers = np.concatenate([trajectory.T[:, :3, 3], q], axis=1).tolist()
    stamps = map(format_seconds, trajectory.stamps_ns.tolist())
    return "".join(f"{t} {_format_numbers(row)}\n" for t, row in zip(stamps, numbers, strict=True))


def read_tum(path: Path, losses: DataLosses | None = None) -> Trajectory:
    """Read a TUM file. losses: gets damaged lines.

    Raises DataError that names file and line if losses is None, or more than 5 % are damaged.
    """
    stamps_ns, numbers = read_tum_table(path, losses=losses)
    return make_trajectory(stamps_ns, numbers[:, :3], numbers[:, 3:], path, losses)


def read_tum_table(path: Path, nan: bool = False, losses: DataLosses | None = None) -> tuple[I64, F64]:
    """Read stamps (N,) ns and x y z qx qy qz qw (N, 7). nan: these may be NaN. Raises as `read_tum`."""

    def parse(fields: list[str], where: str) -> tuple[int, list[float]]:
        return tables.parse_seconds(fields[0], where), tables.parse_numbers(fields[1:8], where, nan)

    stamps_ns, parsed_rows = tables.parse_rows(path, None, 8, parse, losses)
    return stamps_ns, np.array([values for _, values in parsed_rows]).reshape(-1, 7)


def make_trajectory(stamps_ns: I64, p: F64, q: F64, path: Path, losses: DataLosses | None) -> Trajectory:
    """Make a trajectory of positions (N, 3) m and quaternions (N, 4) xyzw; invalid poses go to `losses`.

    Raises as `read_tum`.
    """
    if losses is None:
        return Trajectory(stamps_ns, make_poses(p, q, path))
    norms = _norms(q)
    valid = (np.abs(norms - 1) <= _MAX_NORM_ERROR) & (np.abs(p) <= MAX_POSITION_M).all(1)
    for i in np.flatnonzero(~valid):
        reason = f"quaternion norm is {norms[i]:.3g}, or position beyond {MAX_POSITION_M:g} m"
        losses.add(f"poses of {path}", str(stamps_ns[i]), f"{path}: pose at {stamps_ns[i]} ns: {reason}")
    losses.check(f"poses of {path}", len(valid))
    return Trajectory(stamps_ns[valid], make_poses(p[valid], q[valid], path))


def make_poses(p: F64, q: F64, path: Path) -> F64:
    """Return poses (N, 4, 4) of positions (N, 3) m and quaternions (N, 4) xyzw. Raises DataError."""
    norms = _norms(q)
    invalid = np.flatnonzero(~(np.abs(norms - 1) <= _MAX_NORM_ERROR))
    if len(invalid):
        raise DataError(
            f"{path}: pose {invalid[0] + 1}: quaternion norm is {norms[invalid[0]]:.3g}, expected 1"
        )
    check_position_range(p, path)
    return se3.from_quat(p, q)


def check_position_range(p: F64, path: Path) -> None:
    """Raise DataError if a position (N, 3), m, is out of range."""
    if (far := np.flatnonzero(~(np.abs(p) <= MAX_POSITION_M).all(1))).size:
        raise DataError(f"{path}: pose {far[0] + 1}: is farther than {MAX_POSITION_M:g} m from the origin")


def _norms(q: F64) -> F64:
    """Return the norms (N,) of rows (N, 4) with any values."""
    with np.errstate(over="ignore"):
        out: F64 = np.linalg.norm(q, axis=1)
    return out


def format_seconds(stamp_ns: int) -> str:
    """Format integer nanoseconds as seconds with nine decimals."""
    seconds, fraction = divmod(abs(stamp_ns), 10**9)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{fraction:09d}"


def _format_numbers(values: list[float]) -> str:
    return " ".join(f"{value + 0.0:.9f}" for value in np.round(values, 9).tolist())  # + 0.0: never -0
