"""EuRoC / ASL folders: mav0/{cam0,cam1,imu0}/{data.csv,sensor.yaml,data/} and a ground truth.

Format: Burri et al., *The EuRoC micro aerial vehicle datasets*, IJRR 35(10), 2016.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from share.core.measurement import CAM0, CAM1, LazyImage
from share.errors import ConfigError, DataError
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.io import tables
from share.io.calibration import Calibration, read_euroc
from share.io.images import file_image
from share.io.recording import FolderSource
from share.io.section import read_yaml
from share.io.trajectory import Trajectory, poses
from share.types import F64

TRUTHS = ("state_groundtruth_estimate0", "mocap0", "vicon0")


def is_euroc(path: Path) -> bool:
    return (path / "mav0").is_dir() or (path / "cam0" / "data.csv").is_file()


def open_euroc(path: Path, calibration: Calibration | None, frames: slice | None) -> FolderSource:
    """The recording in `path` (holds mav0, or is it). Raises DataError, ConfigError, UsageError."""
    root = path / "mav0" if (path / "mav0").is_dir() else path
    rig = fit(_own_rig(root) if calibration is None else calibration.rig, root)
    images: dict[str, list[tuple[int, LazyImage]]] = {CAM0: _images(root / CAM0, rig.cam0)}
    if rig.cam1:
        images[CAM1] = _images(root / CAM1, rig.cam1)
    imu = tables.read_table(root / "imu0" / "data.csv", 7) if rig.imu else None
    name = (path if path.name != "mav0" else path.parent).resolve().name
    source = FolderSource(name, rig, images, imu, lambda: _truth(root, rig), _notes(root, rig))
    return source.part(frames)


def fit(rig: Rig, root: Path) -> Rig:
    """The rig, less the IMU where the folder has none. ConfigError if it wants a camera that is missing."""
    missing = "cam1" if rig.cam1 and not (root / CAM1).is_dir() else "depth" if rig.depth else ""
    if missing:
        raise ConfigError(
            f"{root}: the calibration has {missing}, the recording has not; give another --calib"
        )
    if rig.imu and not (root / "imu0").is_dir():
        return rig.without_imu()
    return rig


def _own_rig(root: Path) -> Rig:
    def sensor(name: str) -> Path | None:
        return root / name / "sensor.yaml" if (root / name).is_dir() else None

    return read_euroc(root / CAM0 / "sensor.yaml", sensor(CAM1), sensor("imu0")).rig


def _images(folder: Path, camera: Camera) -> list[tuple[int, LazyImage]]:
    """data.csv's images, all of which must be there."""
    listing = folder / "data.csv"
    lines = list(tables.rows(listing, ",", 2))
    stamps = [tables.parse_ns(fields[0], f"{listing}, line {line}") for line, fields in lines]
    tables.check_sorted(listing, np.array(stamps, np.int64))
    names = [fields[1] for _, fields in lines]
    check_present(folder / "data", names, listing)
    return [
        (stamp, file_image(folder / "data" / name, camera)) for stamp, name in zip(stamps, names, strict=True)
    ]


def check_present(folder: Path, names: list[str], listing: Path) -> None:
    """Raises DataError if files of `names` are not in `folder`: better now than in mid-run."""
    have = set(os.listdir(folder)) if folder.is_dir() else set()
    missing = [name for name in names if name not in have]
    if missing:
        raise DataError(
            f"{listing}: {len(missing)} of {len(names)} images are missing from {folder} "
            f"(first: {missing[0]}); copy the recording again"
        )


def _truth(root: Path, rig: Rig) -> Trajectory | None:
    folder = next((root / name for name in TRUTHS if (root / name / "data.csv").is_file()), None)
    if folder is None:
        return None
    stamps, values = tables.read_table(folder / "data.csv", 8)
    T_world_sensor = poses(values[:, :3], values[:, [4, 5, 6, 3]], folder / "data.csv")
    return Trajectory(stamps, T_world_sensor @ _T_sensor_body(root, folder, rig))


def _T_sensor_body(root: Path, truth: Path, rig: Rig) -> F64:
    """From the body of our rig (IMU, or cam0) to the sensor that the truth tells of."""

    def T_bs(folder: Path) -> F64:
        file = folder / "sensor.yaml"
        return read_yaml(file).pose("T_BS") if file.exists() else np.eye(4)

    return se3.inverse(T_bs(truth)) @ T_bs(root / ("imu0" if rig.imu else CAM0))


def _notes(root: Path, rig: Rig) -> tuple[str, ...]:
    unused = [
        name for name, used in ((CAM1, rig.cam1), ("imu0", rig.imu)) if (root / name).is_dir() and not used
    ]
    return tuple(f"{name} is not used: the calibration does not have it" for name in unused)
