"""`share calibrate realsense`: the calibration that the factory measured, as a file."""

from __future__ import annotations

from pathlib import Path

import click

from share.cli import camera_options, options
from share.errors import UsageError


@click.command(short_help="The factory calibration of an attached RealSense, as files.")
@click.argument("serial", required=False)
@camera_options.profile
@camera_options.mode
@click.option("--depth", is_flag=True, help="Also of the depth stream.")
@options.out_folder
def realsense(serial: str | None, profile_name: str | None, mode: str | None, depth: bool, out: Path) -> None:
    """Write the calibration that the factory stored in the camera, for --calib. SERIAL: which camera, where
    several are attached. The factory measures no IMU noise: the profile's is written. Files that are there
    are not overwritten.

    \b
    Example:  share calibrate realsense --out calib/mine
    """
    from share.cameras.realsense.camera import RealSenseCamera
    from share.cameras.realsense.streams import StreamRequest
    from share.files.writing import atomic_write, writable_dir
    from share.recordings.calibration import CAMCHAIN, IMU_CHAIN, kalibr_texts
    from share.sensors.profile import load_profile

    for path in (out / CAMCHAIN, out / IMU_CHAIN):
        if path.exists():
            raise UsageError(f"{path}: exists and is not overwritten; give another --out")
    request = StreamRequest(load_profile(profile_name or camera_options.PROFILE, mode), depth=depth)
    with RealSenseCamera(request, serial) as camera:
        rig, serial_found = camera.rig, camera.serial
    provenance = f"factory calibration of {serial_found}"
    writable_dir(out)
    for name, text in kalibr_texts(
        rig, f"{provenance}; IMU noise of profile {request.profile.name}", serial_found
    ).items():
        atomic_write(out / name, text)
    size = f"{rig.cam0.width}x{rig.cam0.height}, f {rig.cam0.fx:.1f} {rig.cam0.fy:.1f} px"
    click.echo(f"{out}: {provenance}: {size}, baseline {100 * rig.baseline:.2f} cm")
    click.echo("the IMU's noise is the profile's: the factory measures none, `share calibrate imu` does")
