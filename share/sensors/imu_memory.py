"""The bias that a run has learnt of an IMU, kept for the next run of the same device: one small file each."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from share.config import InertialConfig
from share.errors import DataError, UsageError
from share.files.json_file import own_format_errors, read_json
from share.files.writing import atomic_write, writable_dir, xdg_folder
from share.geometry.camera import ImuBias, ImuNoise

# ---- How well the bias that a run has learnt of its IMU is known when the next run begins.

# From one power-on to the next. What a MEMS sensor adds goes with its temperature: 1 mg/K and 0.015 deg/s/K
# (Bosch BMI055, data sheet), and a camera that is switched on warms up by some 10 K within half an hour; a
# D435i's accelerometer went by 0.14 m/s^2 meanwhile (realsense-ros, issue 1809).
POWER_ON_GYRO, POWER_ON_ACCEL = 0.003, 0.1  # rad/s, m/s^2


def propagate_bias(bias: ImuBias, noise: ImuNoise, age_s: float, config: InertialConfig) -> ImuBias | None:
    """`bias` as of a run that ended `age_s` ago: since then it has walked as the IMU's noise says, and the
    IMU may have been switched off. None where that is no better than what is known of any IMU."""
    random_walk_s = max(age_s, 0.0) * config.imu_noise**2
    gyro = np.sqrt(bias.gyro_sigma**2 + POWER_ON_GYRO**2 + noise.gyro_walk**2 * random_walk_s)
    accel = np.sqrt(bias.accel_sigma**2 + POWER_ON_ACCEL**2 + noise.accel_walk**2 * random_walk_s)
    if not (gyro < config.gyro_bias and accel < config.accel_bias):
        return None
    return ImuBias(bias.gyro, bias.accel, float(gyro), float(accel))


_SCHEMA = 1


class SavedBias(NamedTuple):
    """When the run ended that learnt it, ns since 1970 (UTC), and what it learnt."""

    run_end_ns: int
    bias: ImuBias


def bias_folder() -> Path:
    """$XDG_STATE_HOME/share/imu, or ~/.local/state/share/imu (XDG Base Directory Specification). Raises
    UsageError where nobody has a home."""
    try:
        return xdg_folder("XDG_STATE_HOME", ".local/state") / "share" / "imu"
    except RuntimeError:
        raise UsageError("no home folder to remember the IMU's bias in; set XDG_STATE_HOME") from None


def bias_file(serial: str) -> Path:
    """Where the bias of that device is. Raises DataError for what a device says that is no serial number."""
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,63}", serial):
        raise DataError(f"camera {serial!r:.40}: is no serial number to remember the bias of its IMU by")
    return bias_folder() / f"{serial}.json"


def load_bias(serial: str) -> SavedBias | None:
    """None where nothing is remembered. Raises DataError, UsageError."""
    path = bias_file(serial)
    if not os.path.lexists(path):
        return None
    record = read_json(path)
    with own_format_errors(path):
        if record["schema"] != _SCHEMA or record["serial"] != serial:
            raise ValueError("of another device or of another SHARE")
        gyro, accel = record["gyro"], record["accel"]
        bias = ImuBias(gyro["bias"], accel["bias"], float(gyro["sigma"]), float(accel["sigma"]))
        return SavedBias(int(record["at_ns"]), bias)


def save_bias(serial: str, saved: SavedBias) -> None:
    """In place of what was known of the device. Raises DataError, UsageError, ShareError."""
    path, bias = bias_file(serial), saved.bias
    record = {
        "schema": _SCHEMA,
        "serial": serial,
        "at_ns": saved.run_end_ns,
        "gyro": {"bias": bias.gyro.tolist(), "sigma": bias.gyro_sigma},
        "accel": {"bias": bias.accel.tolist(), "sigma": bias.accel_sigma},
    }
    writable_dir(path.parent)
    atomic_write(path, json.dumps(record, indent=2) + "\n")
