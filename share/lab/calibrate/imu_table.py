"""Read all IMU samples of a recording, with or without cameras, and the noise that it states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from share.errors import UsageError
from share.files.yaml_file import read_yaml
from share.geometry.camera import ImuNoise
from share.recordings import tables
from share.recordings.bags.opening import is_message_file, open_messages
from share.recordings.calibration import IMU_CHAIN, imu_noise
from share.recordings.losses import DataLosses
from share.recordings.session import is_session, read_session
from share.runtime.source import open_source
from share.types import F64, I64, ImuBatch

_SUPPORTED = (
    "an .mcap recording, a ROS bag, one of the RealSense SDK (.db3), SESSION/NAME, a folder with "
    "imu0/data.csv (EuRoC/ASL), or such a data.csv: t[ns],wx,wy,wz,ax,ay,az"
)


@dataclass(frozen=True, eq=False)
class ImuTable:
    """imu: samples in order of time. dropped: number of samples that were damaged or not later than the
    one before. serial: of the device, where known."""

    name: str
    imu: ImuBatch
    dropped: int
    serial: str | None = None


def read_imu(source: str, on_progress: Callable[[int, int], None] = lambda done, total: None) -> ImuTable:
    """Read the samples of the recording named `source`. on_progress(done, total): samples read.

    Raises UsageError where it is no recording, DataError where it is damaged or has no IMU.
    """
    path = Path(source)
    if path.exists() and is_message_file(path):
        return _read_messages(path.stem, path, on_progress)
    if path.suffix == ".db3" and path.is_file():
        return _read_db3(path, on_progress)
    if is_session(path.parent) and not path.exists():
        return _read_messages(path.name, read_session(path.parent).recording(path.name), on_progress)
    for csv in imu_csv_files(path):
        if csv.is_file():
            losses = DataLosses()
            stamps, values = tables.read_table(csv, 7, losses=losses)
            return _clean_table(path.stem, stamps, values, unreadable=sum(losses.counts.values()))
    if not path.exists():
        raise UsageError(f"SOURCE {path}: no such file or folder")
    raise UsageError(f"{source}: is not an IMU recording that SHARE reads; give {_SUPPORTED}")


def imu_csv_files(path: Path) -> list[Path]:
    """Return where the samples of a folder may be; a table itself."""
    if path.suffix == ".csv":
        return [path]
    return [path / "mav0" / "imu0" / "data.csv", path / "imu0" / "data.csv", path / "data.csv"]


def _read_messages(name: str, path: Path, on_progress: Callable[[int, int], None]) -> ImuTable:
    from share.recordings.mcap.reader import read_imu as read
    from share.recordings.mcap.rig import own_serial

    file, losses = open_messages(path), DataLosses()
    stamps, values = read(file, on_progress, losses)
    return _clean_table(name, stamps, values, own_serial(file), sum(losses.counts.values()))


def _read_db3(path: Path, on_progress: Callable[[int, int], None]) -> ImuTable:
    from share.recordings.realsense import Db3, read_recorded_imu  # rosbags is imported only where needed

    on_progress(0, 1)
    file, losses = Db3(path), DataLosses()
    stamps, values = read_recorded_imu(file, losses)
    table = _clean_table(path.stem, stamps, values, file.serial, sum(losses.counts.values()))
    on_progress(1, 1)
    return table


def _clean_table(
    name: str, stamps_ns: I64, values: F64, serial: str | None = None, unreadable: int = 0
) -> ImuTable:
    """Return the valid samples. unreadable: samples lost before. Raises DataError where more than 5 % are
    damaged."""
    finite = np.asarray(np.isfinite(values).all(axis=1))
    losses = DataLosses()
    for k in np.flatnonzero(~finite):
        losses.add("IMU samples", str(k), f"{name}: IMU sample {k + 1} is not finite")
    losses.check("IMU samples", len(finite))
    stamps_ns, values = stamps_ns[finite], values[finite]
    later = rising_mask(stamps_ns)
    imu = ImuBatch(stamps_ns[later], values[later, :3], values[later, 3:])
    dropped = int(np.count_nonzero(~later)) + int(np.count_nonzero(~finite)) + unreadable
    return ImuTable(name, imu, dropped, serial)


def rising_mask(stamps_ns: I64) -> np.ndarray:
    """Return which stamps (N,) are later than all before them."""
    latest, out = np.maximum.accumulate(stamps_ns), np.ones(len(stamps_ns), bool)
    out[1:] = latest[1:] > latest[:-1]
    return out


def stated_noise(source: str, chain_path: str | None, option: str) -> ImuNoise:
    """Return the noise from the IMU chain, or the folder with one, that `option` gave, else from the source.

    Raises UsageError or ConfigError.
    """
    if chain_path is not None:
        chain = read_yaml(chain_file(chain_path, option))
        if "imu0" not in chain:
            raise UsageError(f"{option} {chain_path}: has no imu0; give {IMU_CHAIN}, or a folder with one")
        return imu_noise(chain.section("imu0"), "update_rate")
    noise = _source_noise(Path(source))
    if noise is None:
        raise UsageError(f"{source}: does not state the IMU's noise; give {option} DIR")
    return noise


def _source_noise(source: Path) -> ImuNoise | None:
    """Return the noise that the source states, None where it states none, as a recording of the IMU alone."""
    if source.exists() and is_message_file(source):
        from share.recordings.mcap.rig import own_rig  # imported only where needed

        rig = own_rig(open_messages(source), {}, needed=False)
        return None if rig is None else rig.imu
    table = next((path for path in imu_csv_files(source) if path.is_file()), None)
    if table is None:
        return open_source(str(source)).rig.imu
    sensor_file = table.with_name("sensor.yaml")
    return imu_noise(read_yaml(sensor_file), "rate_hz") if sensor_file.is_file() else None


def chain_file(path_given: str, option: str) -> Path:
    """Return the IMU chain that `option` gave: the file, or that in the folder. Raises UsageError."""
    path = Path(path_given) / IMU_CHAIN if Path(path_given).is_dir() else Path(path_given)
    if not path.is_file():
        raise UsageError(f"{option} {path_given}: has no {IMU_CHAIN}")
    return path
