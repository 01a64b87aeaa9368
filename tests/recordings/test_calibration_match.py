"""A calibration is matched to the device and the streams at hand."""

from dataclasses import replace

import numpy as np
import pytest

from share.errors import ConfigError
from share.geometry.camera import Camera, ImuNoise, Rig
from share.geometry.se3 import from_rt
from share.recordings.calibration_match import (
    device_mismatch,
    fit_to_device,
    fit_to_recording,
    unused_streams,
)

LENS = Camera(640, 480, 385.0, 385.0, 320.0, 240.0)
STEREO = Rig(LENS, np.eye(4), cam1=LENS, T_cam1_cam0=from_rt(np.eye(3), np.array([-0.05, 0, 0])))
ALL = replace(STEREO, depth=LENS, T_depth_cam0=np.eye(4))
RGBD = replace(ALL, cam1=None, T_cam1_cam0=None)


@pytest.mark.parametrize(
    ("said", "serial", "named"),
    [
        (("0123",), "0123", None),
        ((), "0123", None),
        (("0123",), None, None),
        (("0123",), "0456", "0123"),
        (("0456", "0123"), "0456", "0123"),  # cameras of this one, IMU of another
        (("1", "2"), "3", "1, 2"),
    ],
)
def test_a_calibration_of_another_device_gives_a_warning(said, serial, named):
    start = f"the calibration is of device {named}, this is {serial}: "
    assert [text[: len(start)] for text in device_mismatch(said, serial)] == ([start] if named else [])


def test_unused_cameras_are_removed_from_the_rig():
    assert fit_to_device(ALL, STEREO).kind == "stereo" and fit_to_device(ALL, STEREO).depth is None
    assert (fit_to_device(ALL, RGBD).cam1, fit_to_device(ALL, RGBD).depth) == (None, LENS)
    assert fit_to_device(STEREO, ALL).depth is None
    depth, imu = {"cam0": "cam0", "depth": "the depth camera"}, {"imu": "imu0"}
    assert unused_streams(depth, STEREO) == ("the depth camera is not used: the calibration has no depth",)
    assert unused_streams(depth, ALL) == ()
    moved = replace(STEREO, imu=ImuNoise(1e-4, 2e-3, 2e-5, 3e-3, 200.0))
    assert unused_streams(imu, STEREO) == ("imu0 is not used: the calibration has no imu",)
    assert unused_streams(imu, moved) == ()


def test_a_calibration_for_another_image_size_is_refused():
    larger = replace(STEREO, cam0=replace(LENS, width=848), cam1=replace(LENS, width=848))
    with pytest.raises(ValueError, match="its cam0 is 848x480, the camera sends 640x480; add --mode 848x480"):
        fit_to_device(larger, STEREO)
    with pytest.raises(ValueError, match="its depth is 640x480, the camera sends 320x240"):
        fit_to_device(ALL, replace(RGBD, depth=replace(LENS, width=320, height=240)))


def test_a_camera_that_was_not_recorded_is_refused_and_an_imu_left_out():
    with_imu = replace(STEREO, imu=ImuNoise(1e-4, 2e-3, 2e-5, 3e-3, 200.0), timeshift_s=0.1)
    assert fit_to_recording(with_imu, ("cam0", "cam1", "imu"), "a") is with_imu
    fitted = fit_to_recording(with_imu, ("cam0", "cam1"), "a")
    assert (fitted.kind, fitted.timeshift_s) == ("stereo", 0.0)
    with pytest.raises(ConfigError, match=r"^a: the calibration has cam1, the recording does not; give"):
        fit_to_recording(with_imu, ("cam0", "imu"), "a")
