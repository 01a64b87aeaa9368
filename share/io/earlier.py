"""Files of an earlier calibration in the folder that a new one writes to: none that is better is lost."""

from __future__ import annotations

from pathlib import Path

from share.errors import ConfigError
from share.geometry.camera import ImuNoise
from share.geometry.target import Target
from share.io.calibration import CAMCHAIN, imu_noise
from share.io.section import read_yaml
from share.io.target import read_target

_FAILED = ".failed"


def places(out: Path, passed: bool, *names: str) -> tuple[Path, ...]:
    """Where files of one calibration go: under their names in `out`; or, if it is not to be believed and any
    of them is there already, all beside them, as NAME.failed.EXT."""
    paths = tuple(out / name for name in names)
    kept = not passed and any(path.exists() for path in paths)
    return tuple(failed(path) for path in paths) if kept else paths


def failed(path: Path) -> Path:
    """NAME.failed.EXT."""
    return path.with_name(path.stem + _FAILED + path.suffix)


def written(chain: Path) -> str:
    """What `places` came to for a camchain, for a person."""
    return f"{chain} is written" + (
        "" if chain.name == CAMCHAIN else f"; {CAMCHAIN} is kept as it was, and its report"
    )


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
