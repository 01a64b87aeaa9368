"""Read a motion capture's poses: TUM, CSV of EuRoC and TUM-VI, exports of Vicon and Motive."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from share.errors import DataError, UsageError
from share.lab.mocap.motive import is_motive, read_motive
from share.lab.mocap.trajectory import MocapTrajectory
from share.lab.mocap.vicon import is_vicon, read_vicon
from share.recordings import tables
from share.recordings.trajectory import make_poses, read_tum_table

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

    rotations: as for `read_vicon`. Raises as `read_mocap`.
    """
    csv = path.is_file() and path.suffix.lower() == ".csv"
    if csv and is_vicon(path):
        return read_vicon(path, rotations)
    if csv and is_motive(path):
        return read_motive(path)
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
