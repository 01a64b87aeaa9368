"""The input of ORB-SLAM3's adaptor, without ORB-SLAM3: settings as OpenCV reads them, IMU samples."""

from __future__ import annotations

import json
import subprocess
import sys

import cv2
import numpy as np
import pytest
from helpers.recordings import make_euroc

from share.lab.evaluate.tracker_runs import peer_frames, rig_calibration
from share.lab.peer_trackers import PEERS
from share.runtime.source import open_source

SCRIPT = f"""
import json, sys, types
sys.path.insert(0, {str(PEERS["orbslam3"].path.parent)!r})
sys.modules["pyorbslam3"] = types.ModuleType("pyorbslam3")
import orbslam3
from peer_wire import read_line, read_frame, write_line

told = read_line(sys.stdin.buffer)
samples, taken = orbslam3.ImuQueue(), []
while (moment := read_frame(sys.stdin.buffer)) is not None:
    taken.append(samples.take_until(moment, 0)[:, 0].tolist())
write_line(orbslam3.ANSWER_STREAM, dict(settings=orbslam3.settings_yaml(told), taken=taken))
"""


@pytest.fixture
def source(tmp_path):
    return open_source(str(make_euroc(tmp_path / "recording", frames=8)))


@pytest.fixture
def reported(source, tmp_path):
    """What the adaptor makes of the recording."""
    return answered(tmp_path, rig_calibration(source), peer_frames(source))


def answered(tmp_path, rig, what):
    from share.lab.peer_trackers.peer_wire import write_frame, write_line

    with (tmp_path / "moments").open("wb") as file:
        write_line(file, rig)
        for moment in what:
            write_frame(file, moment)
    with (tmp_path / "moments").open("rb") as file:
        done = subprocess.run([sys.executable, "-c", SCRIPT], stdin=file, capture_output=True, timeout=60)
    assert done.returncode == 0, done.stderr.decode()
    return json.loads(done.stdout)


def test_settings_are_the_recordings(reported, source):
    read = cv2.FileStorage(reported["settings"], cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    rig = source.rig
    assert read.getNode("Camera.type").string() == "PinHole"
    assert read.getNode("Camera.width").real() == rig.cam0.width
    for name, camera in (("Camera1", rig.cam0), ("Camera2", rig.cam1)):
        for key, value in zip(("fx", "fy", "cx", "cy"), camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], strict=True):
            node = read.getNode(f"{name}.{key}")
            assert node.isReal()  # ORB-SLAM3 ends where a number of these is whole
            assert node.real() == pytest.approx(value)
        assert read.getNode(f"{name}.p2").real() == pytest.approx(camera.distortion[3])
    T_cam0_cam1 = read.getNode("Stereo.T_c1_c2").mat()
    assert T_cam0_cam1 == pytest.approx(np.linalg.inv(rig.T_cam1_cam0), abs=1e-6)
    assert read.getNode("IMU.T_b_c1").mat() == pytest.approx(rig.T_body_cam0, abs=1e-6)
    assert read.getNode("Camera1.k3").empty()
    for name in ("IMU.Frequency", "IMU.NoiseGyro", "Stereo.ThDepth", "Viewer.ViewpointX"):
        assert read.getNode(name).isReal()


def test_a_fifth_coefficient_is_passed_on(source, tmp_path):
    rig = rig_calibration(source)
    rig["cameras"][0]["distortion"] = [0.1, 0.2, 0.3, 0.4, 0.5]
    settings = answered(tmp_path, rig, [])["settings"]
    read = cv2.FileStorage(settings, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    assert [read.getNode(f"Camera1.{key}").real() for key in ("k1", "k2", "p1", "p2", "k3")] == [
        0.1,
        0.2,
        0.3,
        0.4,
        0.5,
    ]
    assert read.getNode("Camera2.k3").empty()


def test_each_frame_has_the_samples_since_the_one_before(reported, source):
    stamps = [moment.stamp_ns for moment in peer_frames(source)]
    recorded = [m.stamp_ns for m in source.measurements() if m.stream == "imu"]
    before = 0
    for stamp, taken in zip(stamps, reported["taken"], strict=True):
        wanted = [1e-9 * ns for ns in recorded if before < ns <= stamp]
        assert taken == pytest.approx(wanted, abs=1e-6)
        before = stamp
