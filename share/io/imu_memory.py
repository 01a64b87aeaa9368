"""The bias that a run has learnt of an IMU, kept for the next run of the same device: one small file each."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import NamedTuple

from share.errors import DataError, UsageError
from share.geometry.camera import ImuBias
from share.io.files import atomic_write, writable_dir, xdg_folder
from share.io.json_file import as_we_write_it, read_json

_SCHEMA = 1


class Remembered(NamedTuple):
    """When the run ended that learnt it, ns since 1970 (UTC), and what it learnt."""

    at_ns: int
    bias: ImuBias


def folder() -> Path:
    """$XDG_STATE_HOME/share/imu, or ~/.local/state/share/imu (XDG Base Directory Specification). Raises
    UsageError where nobody has a home."""
    try:
        return xdg_folder("XDG_STATE_HOME", ".local/state") / "share" / "imu"
    except RuntimeError:
        raise UsageError("no home folder to remember the IMU's bias in; set XDG_STATE_HOME") from None


def file_of(serial: str) -> Path:
    """Where the bias of that device is. Raises DataError for what a device says that is no serial number."""
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,63}", serial):
        raise DataError(f"camera {serial!r:.40}: is no serial number to remember the bias of its IMU by")
    return folder() / f"{serial}.json"


def recall(serial: str) -> Remembered | None:
    """None where nothing is remembered. Raises DataError, UsageError."""
    path = file_of(serial)
    if not os.path.lexists(path):
        return None
    told = read_json(path)
    with as_we_write_it(path):
        if told["schema"] != _SCHEMA or told["serial"] != serial:
            raise ValueError("of another device or of another SHARE")
        gyro, accel = told["gyro"], told["accel"]
        bias = ImuBias(gyro["bias"], accel["bias"], float(gyro["sigma"]), float(accel["sigma"]))
        return Remembered(int(told["at_ns"]), bias)


def remember(serial: str, what: Remembered) -> None:
    """In place of what was known of the device. Raises DataError, UsageError, ShareError."""
    path, bias = file_of(serial), what.bias
    told = {
        "schema": _SCHEMA,
        "serial": serial,
        "at_ns": what.at_ns,
        "gyro": {"bias": bias.gyro.tolist(), "sigma": bias.gyro_sigma},
        "accel": {"bias": bias.accel.tolist(), "sigma": bias.accel_sigma},
    }
    writable_dir(path.parent)
    atomic_write(path, json.dumps(told, indent=2) + "\n")
