"""Read EuRoC/ASL folders: mav0/{cam0,cam1,imu0}/{data.csv,sensor.yaml,data/} and ground truth.

Format: Burri et al., *The EuRoC micro aerial vehicle datasets*, IJRR 35(10), 2016.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from share.errors import ConfigError
from share.files.reading import path_inside
from share.files.yaml_file import read_yaml
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.recordings import tables
from share.recordings.calibration import Calibration, read_asl_calibration
from share.recordings.images import file_image
from share.recordings.losses import DataLosses
from share.recordings.recording import FolderSource
from share.recordings.trajectory import Trajectory, make_trajectory
from share.sensors.measurement import CAM0, CAM1, LazyImage
from share.types import F64

TRUTH_FOLDERS = ("state_groundtruth_estimate0", "mocap0", "vicon0")


def is_euroc(path: Path) -> bool:
    return (path / "mav0").is_dir() or (path / "cam0" / "data.csv").is_file()


def open_euroc(path: Path, calibration: Calibration | None, frames: slice | None) -> FolderSource:
    """Open the recording in `path` (mav0 or its parent). Raises DataError, ConfigError, UsageError."""
    root = path / "mav0" if (path / "mav0").is_dir() else path
    rig = fit_rig_to_folder(_own_rig(root) if calibration is None else calibration.rig, root)
    losses = DataLosses()
    images: dict[str, list[tuple[int, LazyImage]]] = {CAM0: _images(root / CAM0, rig.cam0, losses)}
    if rig.cam1:
        images[CAM1] = _images(root / CAM1, rig.cam1, losses)
    imu = tables.read_table(root / "imu0" / "data.csv", 7, losses=losses) if rig.imu else None
    name = (path if path.name != "mav0" else path.parent).resolve().name
    source = FolderSource(
        name, rig, images, imu, lambda: _truth(root, rig, losses), _notes(root, rig), losses
    )
    return source.slice_frames(frames)


def fit_rig_to_folder(rig: Rig, root: Path) -> Rig:
    """Return the rig, without the IMU if the folder has none. Raises ConfigError if a camera is missing."""
    missing = "cam1" if rig.cam1 and not (root / CAM1).is_dir() else "depth" if rig.depth else ""
    if missing:
        raise ConfigError(
            f"{root}: the calibration has {missing}, the recording does not; give another --calib"
        )
    if rig.imu and not (root / "imu0").is_dir():
        return rig.without_imu()
    return rig


def _own_rig(root: Path) -> Rig:
    def sensor(name: str) -> Path | None:
        return root / name / "sensor.yaml" if (root / name).is_dir() else None

    return read_asl_calibration(root / CAM0 / "sensor.yaml", sensor(CAM1), sensor("imu0")).rig


def _images(folder: Path, camera: Camera, losses: DataLosses) -> list[tuple[int, LazyImage]]:
    """Return stamp and image of each line of data.csv whose file exists."""
    listing, data = folder / "data.csv", folder / "data"

    def parse(fields: list[str], where: str) -> tuple[int, str]:
        path_inside(data, fields[1], where)
        return tables.parse_ns(fields[0], where), fields[1]

    _, listed = tables.parse_rows(listing, ",", 2, parse, losses)
    existing = existing_images(data, [name for _, name in listed], listing, losses)
    return [(stamp, file_image(data / name, camera)) for stamp, name in listed if name in existing]


def existing_images(folder: Path, names: list[str], listing: Path, losses: DataLosses) -> set[str]:
    """Return which of the images `names` exist in `folder`; missing ones go to `losses`.

    Raises DataError if more than 5 % are missing.
    """
    existing = set(os.listdir(folder)) if folder.is_dir() else set()
    kind = f"images of {listing}"
    for name in (name for name in names if name not in existing):
        losses.add(kind, name, f"{listing}: {name} is missing from {folder}; copy the recording again")
    losses.check(kind, len(names))
    return existing


def _truth(root: Path, rig: Rig, losses: DataLosses) -> Trajectory | None:
    folder = next((root / name for name in TRUTH_FOLDERS if (root / name / "data.csv").is_file()), None)
    if folder is None:
        return None
    file = folder / "data.csv"
    stamps, values = tables.read_table(file, 8, losses=losses)
    truth = make_trajectory(stamps, values[:, :3], values[:, [4, 5, 6, 3]], file, losses)
    return Trajectory(truth.stamps_ns, truth.T @ _T_sensor_body(root, folder, rig))


def _T_sensor_body(root: Path, truth: Path, rig: Rig) -> F64:
    """Return the pose (4, 4) of our rig's body (IMU or cam0) in the frame of the ground truth's sensor."""

    def T_bs(folder: Path) -> F64:
        file = folder / "sensor.yaml"
        return read_yaml(file).pose("T_BS") if file.exists() else np.eye(4)

    return se3.inverse(T_bs(truth)) @ T_bs(root / ("imu0" if rig.imu else CAM0))


def _notes(root: Path, rig: Rig) -> tuple[str, ...]:
    unused = [
        name for name, used in ((CAM1, rig.cam1), ("imu0", rig.imu)) if (root / name).is_dir() and not used
    ]
    return tuple(f"{name} is not used: the calibration has no {name}" for name in unused)
