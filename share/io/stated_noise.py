"""How noisy an IMU is, by a file or by the recording itself."""

from __future__ import annotations

from pathlib import Path

from share.errors import UsageError
from share.geometry.camera import ImuNoise
from share.io.calibration import IMU_CHAIN, imu_noise
from share.io.section import read_yaml
from share.io.source import open_source


def stated_noise(source: str, given: str | None, option: str) -> ImuNoise:
    """Of what `option` gave (an IMU chain, or a folder with one), else as the source carries it.

    Raises UsageError or ConfigError.
    """
    if given is not None:
        return imu_noise(read_yaml(chain_file(given, option)).section("imu0"), "update_rate")
    if Path(source).suffix == ".csv":
        raise UsageError(f"{source}: a table does not say how noisy the IMU is; give {option} DIR")
    noise = open_source(source).rig.imu
    if noise is None:
        raise UsageError(f"{source}: does not say how noisy the IMU is; give {option} DIR")
    return noise


def chain_file(given: str, option: str) -> Path:
    """The IMU chain that `option` gave: it, or the one in that folder. Raises UsageError."""
    path = Path(given) / IMU_CHAIN if Path(given).is_dir() else Path(given)
    if not path.is_file():
        raise UsageError(f"{option} {given}: has no {IMU_CHAIN}")
    return path
