"""A motion capture's poses from a file: TUM, CSV as EuRoC and TUM-VI have it, Vicon's or Motive's export."""

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
    """`.csv`: t[ns], x y z, qw qx qy qz, and more that is not read; else TUM: t[s] x y z qx qy qz qw.

    unseen: rows with NaN, or a quaternion of zeros, are the body not seen, a gap; else they are damage.
    Raises UsageError without such a file, DataError that names it for what is damaged.
    """
    if not path.is_file():
        raise UsageError(f"{path}: no such file of motion capture")
    if path.suffix.lower() == ".csv":
        stamps, values = tables.read_table(path, 8, nan=allow_unseen)
        values = values[:, [0, 1, 2, 4, 5, 6, 3]]
    else:
        stamps, values = read_tum_table(path, nan=allow_unseen)
    is_visible = ~np.isnan(values).any(1) & (values[:, 3:] != 0).any(1) | (not allow_unseen)
    if not is_visible.any():
        raise DataError(f"{path}: the body was never seen: no pose, NaN and zeros only")
    values[~is_visible] = _IDENTITY_POSE  # still there, so that a complaint counts the poses of the file
    try:
        return MocapTrajectory(stamps[is_visible], make_poses(values[:, :3], values[:, 3:], path)[is_visible])
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def read_bodies(path: Path, rotations: str = "helical") -> Mapping[str, MocapTrajectory | None]:
    """All rigid bodies of a file by their names, None for one that was never seen; "" in a file that tells of
    one without naming it.

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
    """Which of the bodies in a file a device is, and its poses: the one wanted, else the one of the device's
    name, else the only one that the file names. option: how a person may say which. Raises UsageError."""
    matches = [
        body for body in bodies if body.lower() == (device if body_wanted is None else body_wanted).lower()
    ]
    if not matches and body_wanted is None and len(bodies) == 1:
        matches = list(bodies)
    if matches:
        poses_found = bodies[matches[0]]
        if poses_found is None:
            raise UsageError(
                f"{file}: body '{matches[0]}' "
                f"is in the file but "
                f"was never seen; record again with its markers "
                f"in sight, or name another ({option})"
            )
        return matches[0], poses_found
    listed = ", ".join(bodies) if any(bodies) else "one without a name"
    missing = f"body for '{device}' (give {option})" if body_wanted is None else f"body '{body_wanted}'"
    raise UsageError(f"{file}: has no {missing}; it has {listed}")
