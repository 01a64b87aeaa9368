"""ORB-SLAM3 from the wheel `pyorbslam3` (stereo and IMU, no viewer) at the end of a pipe.

    PYTHON share/lab/peer_trackers/orbslam3.py --version | --vocabulary FILE

`share evaluate compare` runs it in the interpreter of an environment with `pyorbslam3`; see peer_wire. FILE:
ORBvoc.txt of its authors. Its mapping runs in threads beside the tracker, so frames are read no sooner than
they were recorded; none is dropped. Features and thresholds: the authors' EuRoC example.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from peer_wire import PeerFrame, claim_stdout, pose_matrix, read_frame, read_line, write_line

ANSWER_STREAM = claim_stdout()  # the library logs to stdout

import pyorbslam3  # noqa: E402

F64 = NDArray[np.float64]

SETTINGS = """\
Stereo.ThDepth: 60.0
ORBextractor.nFeatures: 1200
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""


def settings_yaml(calibration: dict[str, Any]) -> str:
    """Return ORB-SLAM3's settings. It rectifies the images itself, by OpenCV's `stereoRectify`."""
    left, right = calibration["cameras"]
    imu, T_left, T_right = calibration["imu"], *(np.array(c["T_body_cam"]) for c in (left, right))
    numbers = {
        "Camera.width": left["width"],
        "Camera.height": left["height"],
        "Camera.fps": round(calibration["rate_hz"]),
        "Camera.RGB": 1,
        **_camera("Camera1", left),
        **_camera("Camera2", right),
        "IMU.NoiseGyro": imu["gyro_density"],
        "IMU.NoiseAcc": imu["accel_density"],
        "IMU.GyroWalk": imu["gyro_walk"],
        "IMU.AccWalk": imu["accel_walk"],
        "IMU.Frequency": float(imu["rate_hz"]),
        "IMU.InsertKFsWhenLost": 0,
    }
    matrices = {"Stereo.T_c1_c2": np.linalg.inv(T_left) @ T_right, "IMU.T_b_c1": T_left}
    lines = ["%YAML:1.0", 'File.version: "1.0"', 'Camera.type: "PinHole"']
    lines += [f"{name}: {value!r}" for name, value in numbers.items()]
    for name, T in matrices.items():
        data = ", ".join(repr(float(value)) for value in T.ravel())
        lines.append(f"{name}: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: f\n   data: [{data}]")
    return "\n".join(lines) + "\n" + SETTINGS


def _camera(name: str, camera: dict[str, Any]) -> dict[str, float]:
    K, distortion = camera["K"], camera["distortion"] or [0.0] * 4
    values = (K[0][0], K[1][1], K[0][2], K[1][2], *distortion)
    keys = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")[: len(values)]
    return {f"{name}.{key}": float(value) for key, value in zip(keys, values, strict=True)}


class ImuQueue:
    """IMU samples for each frame: all after the previous frame, up to this one."""

    def __init__(self) -> None:
        self._pending = np.zeros((0, 7))

    def take_until(self, frame: PeerFrame, start_ns: int) -> F64:
        """Return (N, 7): seconds since start_ns, gyro rad/s, accelerometer m/s^2."""
        new = np.column_stack([1e-9 * (frame.imu_ns - start_ns), frame.imu])
        samples = np.concatenate([self._pending, new])
        count = int(np.searchsorted(samples[:, 0], 1e-9 * (frame.stamp_ns - start_ns), "right"))
        self._pending = samples[count:]
        return samples[:count]


def paced_frames() -> Iterator[tuple[PeerFrame, float]]:
    """Yield frames no sooner after the first than they were recorded, with the CPU time, s, that reading
    each took."""
    first_ns, began, cpu_start_s = None, 0.0, time.thread_time()
    while (frame := read_frame(sys.stdin.buffer)) is not None:
        read_cpu_s = time.thread_time() - cpu_start_s
        if first_ns is None:
            first_ns, began = frame.stamp_ns, time.monotonic()
        time.sleep(max(0.0, 1e-9 * (frame.stamp_ns - first_ns) - (time.monotonic() - began)))
        yield frame, read_cpu_s
        cpu_start_s = time.thread_time()


def final_trajectory(slam: Any, folder: Path, start_ns: int) -> dict[str, Any]:
    """Return the trajectory of the body by the final map."""
    file = folder / "final.txt"
    slam.save_trajectory_euroc(str(file))
    rows = np.loadtxt(file, ndmin=2) if file.exists() and file.stat().st_size else np.zeros((0, 8))
    poses = [pose_matrix(row[1:4], row[4:8]).tolist() for row in rows]
    return {"stamps_ns": [round(row[0]) + start_ns for row in rows], "T_world_body": poses}


def track_all(slam: Any, calibration: dict[str, Any]) -> int:
    """Answer every frame; return the time origin, ns."""
    T_rect_body = np.linalg.inv(calibration["cameras"][0]["T_body_cam"])
    T_rect_body[:3] = np.array(calibration["R_rectified_cam0"]) @ T_rect_body[:3]
    samples, start_ns, cpu_start_s = ImuQueue(), None, time.process_time()
    for frame, read_cpu_s in paced_frames():
        start_ns = int(frame.imu_ns[0]) if start_ns is None else start_ns
        result = slam.track_stereo(
            frame.left,
            frame.right,
            1e-9 * (frame.stamp_ns - start_ns),
            imu=samples.take_until(frame, start_ns),
        )
        T = result.pose_wc @ T_rect_body if result.pose_valid else None
        cpu_s = time.process_time() - cpu_start_s - read_cpu_s  # of all threads, mapping included
        cpu_start_s = time.process_time()
        write_line(ANSWER_STREAM, {"T_world_body": None if T is None else T.tolist(), "cpu_s": cpu_s})
    return start_ns or 0


def main() -> None:
    if "--version" in sys.argv:
        write_line(ANSWER_STREAM, {"version": f"ORB-SLAM3 of pyorbslam3 {version('pyorbslam3')}"})
        return
    vocabulary = sys.argv[sys.argv.index("--vocabulary") + 1]
    calibration = read_line(sys.stdin.buffer)
    assert calibration is not None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "settings.yaml").write_text(settings_yaml(calibration))
        slam = pyorbslam3.Slam(vocabulary, folder / "settings.yaml", pyorbslam3.Sensor.IMU_STEREO)
        start_ns = track_all(slam, calibration)
        slam.shutdown()
        write_line(ANSWER_STREAM, final_trajectory(slam, folder, start_ns))


if __name__ == "__main__":
    main()
