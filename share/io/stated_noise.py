"""How noisy an IMU is, by a file or by the recording itself."""

from __future__ import annotations

from pathlib import Path

from share.errors import UsageError
from share.geometry.camera import ImuNoise
from share.io.calibration import IMU_CHAIN, imu_noise
from share.io.imu_table import imu_tables
from share.io.section import read_yaml
from share.io.source import open_source


def stated_noise(source: str, given: str | None, option: str) -> ImuNoise:
    """Of what `option` gave (an IMU chain, or a folder with one), else as the source carries it.

    Raises UsageError or ConfigError.
    """
    if given is not None:
        chain = read_yaml(chain_file(given, option))
        if "imu0" not in chain:
            raise UsageError(f"{option} {given}: has no imu0; give {IMU_CHAIN}, or a folder with one")
        return imu_noise(chain.section("imu0"), "update_rate")
    noise = _own(Path(source))
    if noise is None:
        raise UsageError(f"{source}: does not say how noisy the IMU is; give {option} DIR")
    return noise


def _own(source: Path) -> ImuNoise | None:
    """As the source says, with cameras or without: one that was recorded for its IMU alone has none."""
    if source.suffix == ".mcap" and source.is_file():
        from share.io.mcap.file import McapFile  # only where they are needed
        from share.io.mcap.reader import own_rig

        rig = own_rig(McapFile(source), {}, needed=False)
        return None if rig is None else rig.imu
    table = next((path for path in imu_tables(source) if path.is_file()), None)
    if table is None:
        return open_source(str(source)).rig.imu
    sheet = table.with_name("sensor.yaml")
    return imu_noise(read_yaml(sheet), "rate_hz") if sheet.is_file() else None


def chain_file(given: str, option: str) -> Path:
    """The IMU chain that `option` gave: it, or the one in that folder. Raises UsageError."""
    path = Path(given) / IMU_CHAIN if Path(given).is_dir() else Path(given)
    if not path.is_file():
        raise UsageError(f"{option} {given}: has no {IMU_CHAIN}")
    return path
