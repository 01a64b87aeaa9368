"""`share calibrate realsense`: write the factory calibration of a RealSense to files."""

from __future__ import annotations

from pathlib import Path

import click

from share.cli import camera_options, options
from share.errors import UsageError


@click.command(short_help="Write the factory calibration of an attached RealSense.")
@click.argument("serial", required=False)
@camera_options.profile
@camera_options.mode
@click.option("--depth", is_flag=True, help="Include the depth stream.")
@options.out_folder
def realsense(serial: str | None, profile_name: str | None, mode: str | None, depth: bool, out: Path) -> None:
    """Write the factory calibration stored in a RealSense camera, for use with --calib.

    SERIAL selects the camera if several are attached. The factory does not measure IMU noise: the profile's
    is written. Existing files are not overwritten.

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
            raise UsageError(f"{path} exists and is not overwritten; give another --out")
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
    click.echo("IMU noise: from the profile; measure it with `share calibrate imu`")
