"""Files of an earlier calibration in the folder that a new one writes to: none that is better is lost."""

from __future__ import annotations

from pathlib import Path

from share.errors import ConfigError
from share.geometry.camera import ImuNoise
from share.geometry.target import Target
from share.io.calibration import CAMCHAIN, imu_noise
from share.io.section import read_yaml
from share.io.target import read_target

_FAILED = ".failed.yaml"


def camchain_path(out: Path, passed: bool) -> Path:
    """Where a camchain goes: beside the one that is there, if the new one is not to be believed."""
    chain = out / CAMCHAIN
    return chain if passed or not chain.exists() else chain.with_suffix(_FAILED)


def written(chain: Path) -> str:
    """What `camchain_path` came to, for a person."""
    return f"{chain} is written" + ("" if chain.name == CAMCHAIN else f"; {CAMCHAIN} is kept as it was")


def says_noise(chain: Path, noise: ImuNoise) -> bool:
    """Whether an IMU chain, which is there, is of this noise."""
    try:
        return imu_noise(read_yaml(chain).section("imu0"), "update_rate") == noise
    except ConfigError:  # damaged, and perhaps the only one of its kind
        return False


def says_target(file: Path, target: Target) -> bool:
    """Whether a target's file, which is there, is of this target."""
    try:
        return read_target(file) == target
    except ConfigError:
        return False
