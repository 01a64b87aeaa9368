"""Small recordings in all forms, for the tests of readers and commands."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 64, 48
START_NS = 1_403_715_273_262_142_976
STEP_NS = 50_000_000

CAMERA = f"""%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, {{x}}, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [{WIDTH}, {HEIGHT}]
camera_model: pinhole
intrinsics: [50.0, 51.0, 31.5, 23.5]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.76e-05]
"""
IMU = """%YAML:1.0
sensor_type: imu
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
rate_hz: 200
gyroscope_noise_density: 1.7e-04
gyroscope_random_walk: 1.9e-05
accelerometer_noise_density: 2.0e-3
accelerometer_random_walk: 3.0e-3
"""
RGBD = f"""camera_model: pinhole
resolution: [{WIDTH}, {HEIGHT}]
intrinsics: [50.0, 50.0, 32.0, 24.0]
distortion_model: none
depth_intrinsics: [60.0, 60.0, 32.0, 24.0]
T_depth_cam0: [[1, 0, 0, 0.025], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
depth_scale: 1000.0
"""


def picture(number: int, channels: int = 1) -> np.ndarray:
    """A smooth, textured image; different for each number."""
    rng = np.random.default_rng(number)
    shape = (HEIGHT, WIDTH) if channels == 1 else (HEIGHT, WIDTH, channels)
    return np.asarray(cv2.GaussianBlur(rng.integers(0, 256, shape, np.uint8), (0, 0), 1.5))


def depth_mm(number: int) -> np.ndarray:
    return np.random.default_rng(1000 + number).integers(0, 5000, (HEIGHT, WIDTH), np.uint16)


def make_euroc(root: Path, frames: int = 6, imu: bool = True, suffix: str = ".jpg") -> Path:
    """A stereo + IMU folder, IMU at 200 Hz from one frame before to one after, and a truth."""
    stamps = [START_NS + i * STEP_NS for i in range(frames)]
    for cam, x in (("cam0", 0.0), ("cam1", 0.11)):
        folder = root / "mav0" / cam
        (folder / "data").mkdir(parents=True)
        (folder / "sensor.yaml").write_text(CAMERA.format(x=x))
        for i, stamp in enumerate(stamps):
            cv2.imwrite(str(folder / "data" / f"{stamp}{suffix}"), picture(i + 100 * (cam == "cam1")))
        lines = [f"{stamp},{stamp}{suffix}\n" for stamp in stamps]
        (folder / "data.csv").write_text("#timestamp [ns],filename\n" + "".join(lines))
    if imu:
        _make_imu(root / "mav0" / "imu0", frames)
    truth = root / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir()
    rows = "".join(f"{s},{0.1 * i},0.0,1.0,1.0,0.0,0.0,0.0\n" for i, s in enumerate(stamps))
    (truth / "data.csv").write_text("#timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z\n" + rows)
    return root


def _make_imu(folder: Path, frames: int) -> None:
    folder.mkdir()
    (folder / "sensor.yaml").write_text(IMU)
    rng = np.random.default_rng(7)
    rows = []
    for k in range(-10, 10 * frames + 1):
        values = ",".join(repr(float(v)) for v in rng.normal(size=6))
        rows.append(f"{START_NS + k * STEP_NS // 10},{values}\n")
    (folder / "data.csv").write_text("#timestamp,w_x,w_y,w_z,a_x,a_y,a_z\n" + "".join(rows))


def make_tum(root: Path, frames: int = 5, associations: bool = False) -> Path:
    """An RGB-D folder, colour JPEG and 16-bit depth, depth 4 ms after colour, and a truth."""
    (root / "rgb").mkdir(parents=True)
    (root / "depth").mkdir()
    (root / "camera.yaml").write_text(RGBD)
    colour, depth, both, truth = [], [], [], []
    for i in range(frames):
        t, d = f"{10 + i / 30:.6f}", f"{10 + i / 30 + 0.004:.6f}"
        cv2.imwrite(str(root / "rgb" / f"{i}.jpg"), picture(i, 3))
        cv2.imwrite(str(root / "depth" / f"{i}.png"), depth_mm(i))
        colour.append(f"{t} rgb/{i}.jpg\n")
        depth.append(f"{d} depth/{i}.png\n")
        both.append(f"{t} rgb/{i}.jpg {d} depth/{i}.png\n")
        truth.append(f"{t} {0.1 * i} 0 0 0 0 0 1\n")
    if associations:
        (root / "associations.txt").write_text("".join(both))
    else:
        (root / "rgb.txt").write_text("# colour\n" + "".join(colour))
        (root / "depth.txt").write_text("# depth\n" + "".join(depth))
    (root / "groundtruth.txt").write_text("".join(truth))
    return root
