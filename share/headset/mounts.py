"""Mounts of headsets on devices, from `share calibrate headset`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from share.agent_names import checked_name
from share.errors import UsageError
from share.files.yaml_file import read_yaml

MOUNT_FILE = "headset.yaml"


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
    section = read_yaml(path / MOUNT_FILE if path.is_dir() else path)
    T = section.pose("T_body_viewer")
    key = "timeshift_device_headset"
    shift_ms = section.number(key) * 1e3 if key in section else None
    return ViewerMount(tuple(T.ravel().tolist()), shift_ms)
