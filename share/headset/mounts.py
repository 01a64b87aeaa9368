"""Mounts of headsets on devices, from `share calibrate headset`."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from share.agent_names import checked_name
from share.errors import UsageError
from share.files.yaml_file import read_yaml

MOUNT_FILE = "headset.yaml"
MAX_AWAY_M, MAX_SHIFT_S = 2.0, 1.0


@dataclass(frozen=True)
class ViewerMount:
    """T_body_viewer: 16 numbers, row by row. timeshift_ms: device's clock minus headset's; None: unknown."""

    T_body_viewer: tuple[float, ...]
    timeshift_ms: float | None


def read_mounts(given: Sequence[str]) -> dict[str, ViewerMount]:
    """Return mounts by agent. given: NAME=FILE, or NAME=FOLDER with headset.yaml. Raises UsageError."""
    mounts: dict[str, ViewerMount] = {}
    for text in given:
        name, equals, path = text.partition("=")
        if not (equals and path):
            raise UsageError(f"--mount {text}: expected NAME=FILE, such as ann=calib/ann/{MOUNT_FILE}")
        try:
            name = checked_name(name)
        except ValueError as error:
            raise UsageError(f"--mount {text!r:.80}: {error}") from None
        if name in mounts:
            raise UsageError(f"--mount {text}: '{name}' has a mount already; give one")
        mounts[name] = _read(Path(path))
    return mounts


def _read(path: Path) -> ViewerMount:
    file = path / MOUNT_FILE if path.is_dir() else path
    if not os.path.lexists(file):
        raise UsageError(f"--mount: {file}: no such file; `share calibrate headset` makes it")
    section = read_yaml(file)
    T = section.pose("T_body_viewer")
    if (away_m := math.dist(T[:3, 3], (0, 0, 0))) > MAX_AWAY_M:
        raise UsageError(
            f"--mount: {file}: T_body_viewer: the device is {away_m:.3g} m from the eyes; at most "
            f"{MAX_AWAY_M:g} m is a mount on a head"
        )
    key = "timeshift_device_headset"
    shift_s = section.number(key) if key in section else None
    if shift_s is not None and abs(shift_s) > MAX_SHIFT_S:
        raise UsageError(
            f"--mount: {file}: {key}: {shift_s:.3g} s; at most {MAX_SHIFT_S:g} s is the shift of clocks that "
            "measure one motion"
        )
    return ViewerMount(tuple(T.ravel().tolist()), None if shift_s is None else shift_s * 1e3)
