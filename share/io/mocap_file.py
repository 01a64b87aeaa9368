"""A motion capture's poses from a file: TUM, CSV as EuRoC and TUM-VI have it, or Vicon's export."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from share.errors import DataError, UsageError
from share.io import tables
from share.io.trajectory import poses, read_tum
from share.io.vicon import is_vicon, read_vicon
from share.mocap.mocap import Mocap


def read_mocap(path: Path) -> Mocap:
    """`.csv`: t[ns], x y z, qw qx qy qz, and more that is not read; else TUM: t[s] x y z qx qy qz qw.

    Raises UsageError without such a file, DataError that names it for what is damaged.
    """
    if not path.is_file():
        raise UsageError(f"{path}: no such file of motion capture")
    if path.suffix == ".csv":
        stamps, values = tables.read_table(path, 8)
        T = poses(values[:, :3], values[:, [4, 5, 6, 3]], path)
    else:
        stamps, T = read_tum(path)
    try:
        return Mocap(stamps, T)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def read_bodies(path: Path, rotations: str = "helical") -> dict[str, Mocap]:
    """All rigid bodies of a file by their names; "" in a file that tells of one without naming it.

    rotations: as for `read_vicon`. Raises as `read_mocap`.
    """
    if path.is_file() and path.suffix.lower() == ".csv" and is_vicon(path):
        return read_vicon(path, rotations)
    return {"": read_mocap(path)}


def pick_body(file: str, there: Sequence[str], wanted: str | None, device: str, option: str) -> str:
    """Which of the bodies in a file a device is: the one wanted, else the one of the device's name, else the
    only one. option: how a person may say which. Raises UsageError."""
    alike = [body for body in there if body.lower() == (device if wanted is None else wanted).lower()]
    if alike:
        return alike[0]
    if wanted is None and len(there) == 1:
        return there[0]
    listed = ", ".join(there) if any(there) else "one without a name"
    what = f"body for '{device}' (give {option})" if wanted is None else f"body '{wanted}'"
    raise UsageError(f"{file}: has no {what}; it has {listed}")
