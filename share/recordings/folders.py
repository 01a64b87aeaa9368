"""Read recordings that are folders of image files: EuRoC/ASL and TUM RGB-D.

EuRoC/ASL: mav0/{cam0,cam1,imu0}/{data.csv,sensor.yaml,data/} and ground truth. Source: Burri et al., *The
EuRoC micro aerial vehicle datasets*, IJRR 35(10), 2016.

TUM RGB-D: rgb.txt and depth.txt, or associations.txt, with our camera.yaml. Colour and depth images have
different stamps. They are paired by associations.txt, or by the nearest stamp within 20 ms (as the benchmark
does); the depth image gets the stamp of its colour image. Source: Sturm et al., *A benchmark for the
evaluation of RGB-D SLAM systems*, IROS 2012.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from share.errors import ConfigError, DataError
from share.files.reading import path_inside
from share.files.yaml_file import read_yaml
from share.geometry import se3
from share.geometry.camera import Camera, Rig
from share.recordings import tables
from share.recordings.calibration import Calibration, read_asl_calibration, read_camera_yaml
from share.recordings.calibration_match import fit_to_recording, unused_streams
from share.recordings.images import file_image
from share.recordings.losses import DataLosses
from share.recordings.recording import FolderSource, existing_images
from share.recordings.trajectory import Trajectory, make_trajectory, read_tum
from share.sensors.measurement import CAM0, CAM1, DEPTH, IMU, LazyImage
from share.types import F64

_FOLDERS = {CAM0: "cam0", CAM1: "cam1", IMU: "imu0"}  # by stream
TRUTH_FOLDERS = ("state_groundtruth_estimate0", "mocap0", "vicon0")
CAMERA_FILE = "camera.yaml"
_MAX_PAIR_GAP_NS = 20_000_000

ImagePair = tuple[int, dict[str, str]]  # stamp of the colour image; its file and the depth's, by stream


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
        {name: _euroc_images(root / name, camera, losses) for name, camera in rig.cameras.items()},
        losses,
        imu=tables.read_table(root / "imu0" / "data.csv", 7, losses=losses) if rig.imu else None,
        read_truth=lambda: _euroc_truth(root, rig, losses),
        notes=unused_streams(recorded, rig),
        frames=frames,
    )


def _own_rig(root: Path) -> Rig:
    def sensor(name: str) -> Path | None:
        return root / name / "sensor.yaml" if (root / name).is_dir() else None

    return read_asl_calibration(root / CAM0 / "sensor.yaml", sensor(CAM1), sensor("imu0")).rig


def _euroc_images(folder: Path, camera: Camera, losses: DataLosses) -> list[tuple[int, LazyImage]]:
    """Return stamp and image of each line of data.csv that has its file."""
    listing, data = folder / "data.csv", folder / "data"

    def parse(fields: list[str], where: str) -> tuple[int, str]:
        path_inside(data, fields[1], where)
        return tables.parse_ns(fields[0], where), fields[1]

    _, listed = tables.parse_rows(listing, ",", 2, parse, losses)
    existing = existing_images(data, [name for _, name in listed], listing, losses)
    return [(stamp, file_image(data / name, camera)) for stamp, name in listed if name in existing]


def _euroc_truth(root: Path, rig: Rig, losses: DataLosses) -> Trajectory | None:
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


def is_tum(path: Path) -> bool:
    return any((path / name).is_file() for name in ("rgb.txt", "associations.txt"))


def open_tum(path: Path, calibration: Calibration | None, frames: slice | None) -> FolderSource:
    """Open the recording in `path`. Raises DataError, ConfigError, UsageError."""
    if calibration is None:
        calibration = read_camera_yaml(path / CAMERA_FILE)
    if calibration.rig.depth is None:
        raise ConfigError(f"{calibration.where}: has no depth camera, but {path} is an RGB-D recording")
    rig = fit_to_recording(calibration.rig, (CAM0, DEPTH), path).without_imu()
    losses = DataLosses()
    pairs, notes = _read_pairs(path, losses)
    images: dict[str, list[tuple[int, LazyImage]]] = {
        name: [
            (stamp, file_image(path / files[name], camera, calibration.depth_scale if name == DEPTH else 0.0))
            for stamp, files in pairs
        ]
        for name, camera in rig.cameras.items()
    }
    return FolderSource(
        path,
        rig,
        images,
        losses,
        read_truth=lambda: _tum_truth(path, rig, losses),
        notes=notes,
        frames=frames,
    )


def _read_pairs(path: Path, losses: DataLosses) -> tuple[list[ImagePair], tuple[str, ...]]:
    listing, notes = path / "associations.txt", tuple[str, ...]()
    if listing.is_file():
        pairs = _read_associations(listing, losses)
    else:
        listing = path / "rgb.txt"
        colour, depth = _read_list(listing, losses), _read_list(path / "depth.txt", losses)
        pairs = _pair_nearest(colour, depth)
        if unpaired := len(colour) - len(pairs):
            notes = (f"{unpaired} of {len(colour)} colour images have no depth image within 20 ms",)
    if not pairs:
        raise DataError(
            f"{listing}: no colour image has a depth image within 20 ms; check that both use one clock"
        )
    for stream in (CAM0, DEPTH):
        existing = existing_images(path, [files[stream] for _, files in pairs], listing, losses)
        pairs = [(stamp, files) for stamp, files in pairs if files[stream] in existing]
    return pairs, notes


def _read_associations(listing: Path, losses: DataLosses) -> list[ImagePair]:
    """Read lines `t colour t depth`, or with depth first (recognised by the folder's name)."""

    def parse(fields: list[str], where: str) -> ImagePair:
        stamp, colour, other, depth = fields[:4]
        if colour.startswith("depth"):
            stamp, colour, depth = other, depth, colour
        for name in (colour, depth):
            path_inside(listing.parent, name, where)
        return tables.parse_seconds(stamp, where), {CAM0: colour, DEPTH: depth}

    return tables.parse_rows(listing, None, 4, parse, losses)[1]


def _read_list(listing: Path, losses: DataLosses) -> list[tuple[int, str]]:
    def parse(fields: list[str], where: str) -> tuple[int, str]:
        path_inside(listing.parent, fields[1], where)
        return tables.parse_seconds(fields[0], where), fields[1]

    return tables.parse_rows(listing, None, 2, parse, losses)[1]


def _pair_nearest(colour: list[tuple[int, str]], depth: list[tuple[int, str]]) -> list[ImagePair]:
    """Pair every colour image with the depth image nearest in time; each depth image is used once."""
    stamps = np.array([stamp for stamp, _ in depth], np.int64)
    pairs, used = [], -1
    for stamp, file in colour:
        right = int(np.searchsorted(stamps, stamp))
        near = min(
            (i for i in (right - 1, right) if 0 <= i < len(stamps)), key=lambda i: abs(stamps[i] - stamp)
        )
        if near > used and abs(int(stamps[near]) - stamp) <= _MAX_PAIR_GAP_NS:
            pairs.append((stamp, {CAM0: file, DEPTH: depth[near][1]}))
            used = near
    return pairs


def _tum_truth(path: Path, rig: Rig, losses: DataLosses) -> Trajectory | None:
    if not (path / "groundtruth.txt").is_file():
        return None
    stamps, T = read_tum(path / "groundtruth.txt", losses)
    return Trajectory(stamps, T @ _T_truth_cam0(path, rig))


def _T_truth_cam0(path: Path, rig: Rig) -> F64:
    """Return the pose (4, 4) of cam0 in the frame of groundtruth.txt, `truth_frame` in camera.yaml.

    That is cam0 or depth. The default is depth if it is separate from cam0: then the truth comes from depth
    fusion.
    """
    default = "cam0" if rig.T_depth_cam0 is None or np.allclose(rig.T_depth_cam0, np.eye(4)) else "depth"
    camera = path / CAMERA_FILE
    frame = read_yaml(camera).text("truth_frame", default) if camera.exists() else default
    if frame not in ("cam0", "depth"):
        raise ConfigError(f"{camera}: truth_frame '{frame}' is not known; known: cam0, depth")
    return np.eye(4) if frame == "cam0" or rig.T_depth_cam0 is None else rig.T_depth_cam0
