"""The IMU bias of a live camera, kept from run to run in one JSON file per device: read at the start, written
at the end.

Recordings have none: their poses must not depend on earlier runs.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from share.cameras.live import LiveSource
from share.config import InertialConfig
from share.errors import DataError, ShareError, UsageError
from share.files.json_file import own_format_errors, read_json
from share.files.writing import atomic_write, writable_dir, xdg_folder
from share.geometry.camera import ImuBias, ImuNoise
from share.runtime.source import Source

# Change of the bias from one power-on to the next, 1 sigma. The bias of a MEMS sensor drifts with
# temperature, 1 mg/K and 0.015 deg/s/K (Bosch BMI055, data sheet), and a camera warms up by some 10 K in half
# an hour; a D435i's accelerometer drifted by 0.14 m/s^2 meanwhile (realsense-ros, issue 1809).
POWER_ON_GYRO = 0.003  # rad/s
POWER_ON_ACCEL = 0.1  # m/s^2

_SCHEMA = 1


def propagate_bias(bias: ImuBias, noise: ImuNoise, age_s: float, config: InertialConfig) -> ImuBias | None:
    """Return `bias` of a run that ended age_s ago with its sigmas as of now.

    Random walk and a possible power cycle have added to them. None if they are no better than the prior for
    any IMU (`config`).
    """
    random_walk_s = max(age_s, 0.0) * config.imu_noise**2
    gyro = np.sqrt(bias.gyro_sigma**2 + POWER_ON_GYRO**2 + noise.gyro_walk**2 * random_walk_s)
    accel = np.sqrt(bias.accel_sigma**2 + POWER_ON_ACCEL**2 + noise.accel_walk**2 * random_walk_s)
    if not (gyro < config.gyro_bias and accel < config.accel_bias):
        return None
    return ImuBias(bias.gyro, bias.accel, float(gyro), float(accel))


class SavedBias(NamedTuple):
    """A bias and the end of the run that estimated it, ns since 1970 (UTC)."""

    run_end_ns: int
    bias: ImuBias


def bias_folder() -> Path:
    """Return $XDG_STATE_HOME/share/imu, or ~/.local/state/share/imu (XDG Base Directory Specification).

    Raises UsageError without a home folder.
    """
    try:
        return xdg_folder("XDG_STATE_HOME", ".local/state") / "share" / "imu"
    except RuntimeError:
        raise UsageError("no home folder to save the IMU's bias in; set XDG_STATE_HOME") from None


def bias_file(serial: str) -> Path:
    """Return the file of a device's bias. Raises DataError for an invalid serial number."""
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,63}", serial):
        raise DataError(
            f"camera {serial!r:.40}: not a valid serial number, so the IMU's bias cannot be saved under it"
        )
    return bias_folder() / f"{serial}.json"


def load_bias(serial: str) -> SavedBias | None:
    """Return the saved bias of a device, None if there is none. Raises DataError, UsageError."""
    path = bias_file(serial)
    if not os.path.lexists(path):
        return None
    record = read_json(path)
    with own_format_errors(path):
        if record["schema"] != _SCHEMA or record["serial"] != serial:
            raise ValueError("of another device or another version of SHARE")
        gyro, accel = record["gyro"], record["accel"]
        bias = ImuBias(gyro["bias"], accel["bias"], float(gyro["sigma"]), float(accel["sigma"]))
        return SavedBias(int(record["at_ns"]), bias)


def save_bias(serial: str, saved: SavedBias) -> None:
    """Save the bias of a device; replaces the previous one. Raises DataError, UsageError, ShareError."""
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


class ImuBiasStore:
    """Loads and saves the bias. `bias` is the initial one, None if unknown. A file error costs one log
    line."""

    def __init__(
        self,
        source: Source,
        config: InertialConfig,
        notify: Callable[[str], None],
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._notify, self._now_ns = notify, now_ns
        live = isinstance(source, LiveSource) and source.rig.imu is not None
        self._serial = source.serial if live else None
        self.bias: ImuBias | None = None
        self._saved_ns: int | None = None
        if self._serial is not None:
            self._load(self._serial, source, config)

    def save(self, bias: ImuBias | None) -> None:
        """Save the bias at the end of a run; None keeps the saved one."""
        if self._serial is None or bias is None:
            return
        try:
            save_bias(self._serial, SavedBias(self._now_ns(), bias))
        except ShareError as error:
            self._notify(f"the IMU bias is not saved: {error}")

    def note_dropped(self) -> None:
        """The tracker does not use the loaded bias; says so once."""
        if self._saved_ns is not None:
            self._saved_ns = None
            self._notify(
                "the IMU bias of the last run is not used: the IMU measures another one at rest; it is "
                "learnt anew"
            )

    def report(self) -> dict[str, Any]:
        """Return, for a live camera with an IMU, the end of the run that saved the bias in use, or None."""
        return {} if self._serial is None else {"imu_bias": {"learnt_at": _utc(self._saved_ns)}}

    def _load(self, serial: str, source: Source, config: InertialConfig) -> None:
        assert source.rig.imu is not None
        try:
            saved = load_bias(serial)
        except ShareError as error:
            self._notify(f"the IMU bias is taken as unknown: {error}")
            return
        if saved is None:
            return
        age_s = (self._now_ns() - saved.run_end_ns) * 1e-9
        if age_s < 0:
            self._notify(
                "the IMU bias is taken as unknown: its file is from the future by this machine's clock"
            )
            return
        self.bias = propagate_bias(saved.bias, source.rig.imu, age_s, config)
        self._saved_ns = None if self.bias is None else saved.run_end_ns


def _utc(at_ns: int | None) -> str | None:
    return None if at_ns is None else time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(at_ns // 10**9))
