"""Unusable rigs are refused in one line; usual ones pass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from share.geometry import se3
from share.geometry.camera import Camera, ImuNoise, Rig
from share.geometry.rig_check import lens_problem, rig_problem

LENS = (-0.28340811, 0.07395907, 0.00019359, 1.76e-05)
EUROC = Camera(752, 480, 458.654, 457.296, 367.215, 248.375, LENS)
FISHEYE = (0.00348, 0.000715, -0.00205, 0.000203)
TUMVI = {
    **{"width": 512, "height": 512, "fx": 191.0, "fy": 191.0, "cx": 255.0, "cy": 257.0},
    **{"distortion": FISHEYE, "model": "equidistant"},
}
NOISE = ImuNoise(1.7e-4, 2.0e-3, 1.9e-5, 3.0e-3, 200.0)
RIG = Rig(EUROC, np.eye(4), EUROC, se3.from_rt(np.eye(3), np.array([-0.11, 0, 0])), imu=NOISE)
DEPTH = replace(RIG, cam1=None, T_cam1_cam0=None, depth=EUROC, T_depth_cam0=np.eye(4))


def turned(degrees: float, axis: int) -> np.ndarray:
    T = se3.from_rt(se3.so3_exp(np.radians(degrees) * np.eye(3)[axis]), np.array([-0.11, 0, 0]))
    return np.asarray(T)


def both(**values: object) -> Rig:
    camera = replace(EUROC, **values)
    return replace(RIG, cam0=camera, cam1=camera)


@pytest.mark.parametrize(
    "rig",
    [
        RIG,
        DEPTH,
        RIG.without_imu(),
        replace(RIG, cam1=None, T_cam1_cam0=None),
        both(distortion=()),
        both(width=64, height=48, fx=40.0, fy=40.0, cx=31.5, cy=23.5),
        both(fx=150.0, fy=150.0, distortion=()),  # 136 degrees
        both(distortion=(-0.4, 0.2, 0.0, 0.0, -0.05)),
        both(**TUMVI),
        both(
            **TUMVI | {"width": 848, "height": 800, "fx": 286.0, "fy": 286.0, "cx": 420.0, "cy": 400.0}
        ),  # T265
        replace(RIG, T_cam1_cam0=turned(10.0, 2)),
        replace(RIG, T_cam1_cam0=turned(15.0, 1)),
    ],
    ids=lambda rig: rig.kind,
)
def test_usual_rigs_pass(rig: Rig) -> None:
    assert rig_problem(rig) is None


@pytest.mark.parametrize(
    ("rig", "says"),
    [
        (replace(RIG.without_imu(), cam1=None, T_cam1_cam0=None), "one camera alone gives no scale"),
        (both(width=16, height=16, cx=8.0, cy=8.0), "16x16 px hold no features"),
        (both(fx=1.0, fy=1.0, distortion=()), "degrees"),
        (both(fx=1e5, fy=1e5), "degrees"),
        (both(**TUMVI | {"fx": 90.0, "fy": 90.0}), "of its image lie beyond 75 degrees off the axis"),
        (both(**TUMVI | {"distortion": (-0.3, 0.0, 0.0, 0.0)}), "distortion folds"),
        (both(fx=4.0), "pixels are nearly square"),
        (both(cx=-900.0), "lies outside an image of 752x480"),
        (both(distortion=(-30.0, 0.0, 0.0, 0.0)), "distortion folds"),
        (both(distortion=(1e4, -1e4, 1e4, 0.0, 1e4)), "distortion folds|degrees"),
        (both(distortion=(0.0, 0.0, 30.0, 0.0)), "distortion folds"),
        (replace(RIG, cam1=replace(EUROC, fx=150.0, fy=150.0, distortion=())), "similar lenses"),
        (replace(RIG, T_cam1_cam0=turned(90.0, 2)), "turned by 90 degrees"),
        (replace(RIG, T_cam1_cam0=turned(90.0, 1)), "% of what cam0 sees"),
        (replace(RIG, T_cam1_cam0=turned(180.0, 0)), "sees 0 % of what cam0 sees"),
        (replace(DEPTH, T_depth_cam0=turned(90.0, 0)), "sees 0 % of what cam0 sees"),
        (replace(DEPTH, T_depth_cam0=se3.from_rt(np.eye(3), np.array([25.0, 0, 0]))), "25 m from cam0"),
        (replace(RIG, T_body_cam0=se3.from_rt(np.eye(3), np.array([0, 500.0, 0]))), "500 m from the IMU"),
        (replace(RIG, imu=replace(NOISE, gyro_density=0.0)), "gyroscope_noise_density"),
        (replace(RIG, imu=replace(NOISE, accel_density=900.0)), "accelerometer_noise_density"),
        (replace(RIG, imu=replace(NOISE, accel_walk=900.0)), "random walk"),
    ],
)
def test_unusable_rigs_are_refused_with_the_reason(rig: Rig, says: str) -> None:
    reported = rig_problem(rig)
    assert reported is not None
    assert any(part in reported for part in says.split("|")), reported
    assert "\n" not in reported and len(reported) < 250


def test_a_lens_is_checked_alone() -> None:
    assert lens_problem(EUROC) is None
    assert "folds" in str(lens_problem(replace(EUROC, distortion=(-30.0, 0.0, 0.0, 0.0))))
