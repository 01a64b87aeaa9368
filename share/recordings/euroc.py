"""Read EuRoC/ASL folders: mav0/{cam0,cam1,imu0}/{data.csv,sensor.yaml,data/} and ground truth.

Format: Burri et al., *The EuRoC micro aerial vehicle datasets*, IJRR 35(10), 2016.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from share.files.reading import path_inside
from share.files.yaml_file import read_yaml
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.recordings import tables
from share.recordings.calibration import Calibration, read_asl_calibration
from share.recordings.calibration_match import fit_to_recording, unused_streams
from share.recordings.images import file_image
from share.recordings.losses import DataLosses
from share.recordings.recording import FolderSource, existing_images
from share.recordings.trajectory import Trajectory, make_trajectory
from share.sensors.measurement import CAM0, CAM1, IMU, LazyImage
from share.types import F64

_FOLDERS = {CAM0: "cam0", CAM1: "cam1", IMU: "imu0"}  # by stream
TRUTH_FOLDERS = ("state_groundtruth_estimate0", "mocap0", "vicon0")


def is_euroc(path: Path) -> bool:
    return (path / "mav0").is_dir() or (path / "cam0" / "data.csv").is_file()


def open_euroc(path: Path, calibration: Calibration | None, frames: slice | None) -> FolderSource:
    """Open the recording in `path` (mav0 or its parent). Raises DataError, ConfigError, UsageError."""
    root = path / "mav0" if (path / "mav0").is_dir() else path
    recorded = {
        stream: folder for stream, folder in _FOLDERS.items() if stream == CAM0 or (root / folder).is_dir()
    }
    own = _own_rig(root) if calibration is None else calibration.rig
    rig, losses = fit_to_recording(own, recorded, root), DataLosses()
    return FolderSource(
        path if path.name != "mav0" else path.parent,
        rig,
        {name: _images(root / name, camera, losses) for name, camera in rig.cameras.items()},
        losses,
        imu=tables.read_table(root / "imu0" / "data.csv", 7, losses=losses) if rig.imu else None,
        read_truth=lambda: _truth(root, rig, losses),
        notes=unused_streams(recorded, rig),
        frames=frames,
    )


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
