"""`share calibrate`: the group of calibration commands."""

from __future__ import annotations

import click

from share.cli.calibrate_camera import camera
from share.cli.calibrate_camera_imu import camera_imu
from share.cli.calibrate_imu import imu
from share.cli.calibrate_mocap import mocap
from share.cli.calibrate_realsense import realsense
from share.cli.calibrate_target import target


@click.group()
def calibrate() -> None:
    """Calibrate a device's cameras and IMU, and how they and a motion capture's body are mounted.

    Order of use: target, camera, imu, camera-imu. Or write the factory's calibration with realsense.

    \b
    Example:  share calibrate imu rest.mcap --profile d435i --out calib/mine
    """


calibrate.add_command(camera)
calibrate.add_command(camera_imu)
calibrate.add_command(imu)
calibrate.add_command(mocap)
calibrate.add_command(realsense)
calibrate.add_command(target)
