"""`share calibrate`: the group of calibration commands; the board to print, and a factory's calibration."""

from __future__ import annotations

import json
from pathlib import Path

import click

from share.cli import camera_options, options
from share.cli.commands import CommandGroup
from share.errors import UsageError


@click.group(cls=CommandGroup, prefix="calibrate ")
def calibrate() -> None:
    """Calibrate a device's cameras and IMU, and how they and a motion capture's body are mounted.

    Order of use: target, camera, imu, camera-imu. Or write the factory's calibration with realsense.

    \b
    Example:  share calibrate imu rest.mcap --profile d435i --out calib/mine
    """


@calibrate.command(short_help="Write a calibration board to print, and its YAML file.")
@click.option(
    "--kind",
    type=click.Choice(["aprilgrid", "charuco"]),
    default="aprilgrid",
    help="aprilgrid (AprilTags, as Kalibr's) or charuco (chessboard with ArUco tags, as OpenCV's).",
)
@click.option(
    "--paper", metavar="P", default="A4", help="Paper: A4 to A0, letter, tabloid, or WIDTHxHEIGHT in mm."
)
@click.option(
    "--columns",
    type=click.IntRange(1),
    metavar="N",
    help="Columns of the board.  [default: 6 tags or 9 squares]",
)
@click.option(
    "--rows", type=click.IntRange(1), metavar="N", help="Rows of the board.  [default: 6 tags or 7 squares]"
)
@click.option(
    "--size",
    type=click.FloatRange(0, min_open=True),
    metavar="MM",
    help="Edge of a tag or square, mm.  [default: the largest whole mm that fit]",
)
@click.option(
    "--out",
    required=True,
    metavar="B.pdf",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Sheet to write; B.yaml goes beside it.",
)
def target(
    kind: str, paper: str, columns: int | None, rows: int | None, size: float | None, out: Path
) -> None:
    """Write a calibration board as a PDF, true to scale, and a YAML file that describes it (for --target).

    Print at 100 % ("actual size"), glue the sheet to something flat and stiff, and measure the edge of a tag
    or square: if it differs from the sheet's figure, correct the YAML file. If B.yaml exists and describes
    another board, it is kept and nothing is written.

    \b
    Example:  share calibrate target --paper A3 --out board.pdf
              share calibrate camera board.mcap --target board.yaml --out calib/mine
    """
    import yaml

    from share.files.writing import atomic_write, check_replaceable, check_writable
    from share.lab.calibrate.camera_report import has_target
    from share.lab.calibrate.target import target_mapping
    from share.lab.calibrate.target_sheet import DEFAULT_SIZES, describe_sheet, make_sheet, sheet_pdf

    if out.suffix.lower() != ".pdf":
        raise UsageError(f"--out {out}: give a name that ends in .pdf")
    default_size = DEFAULT_SIZES[kind]
    try:
        target_sheet = make_sheet(kind, columns or default_size[0], rows or default_size[1], paper, size)
    except ValueError as error:
        raise UsageError(str(error)) from None
    yaml_file = out.with_suffix(".yaml")
    check_writable(out)
    check_replaceable(yaml_file)
    yaml_exists = yaml_file.exists()
    if yaml_exists and not has_target(yaml_file, target_sheet.target):
        raise UsageError(
            f"{yaml_file} describes another board, or its size was corrected, and is kept; give another "
            "--out, or move it away"
        )
    atomic_write(out, sheet_pdf(target_sheet))
    if not yaml_exists:
        atomic_write(yaml_file, yaml.safe_dump(target_mapping(target_sheet.target), sort_keys=False))
    click.echo(
        f"{describe_sheet(target_sheet)}, on {paper} ({target_sheet.width:g} x {target_sheet.height:g} mm)"
    )
    click.echo(f"to print: {out}   for --target: {yaml_file}")


@calibrate.command(short_help="Write the factory calibration of an attached RealSense.")
@click.argument("serial", required=False)
@camera_options.profile
@camera_options.mode
@click.option("--depth", is_flag=True, help="Include the depth stream.")
@options.out_folder
@options.as_json
def realsense(
    serial: str | None, profile_name: str | None, mode: str | None, depth: bool, out: Path, as_json: bool
) -> None:
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
    if as_json:
        lens = {name: getattr(rig.cam0, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        click.echo(json.dumps({"serial": serial_found, "cam0": lens, "baseline_m": rig.baseline}))
        return
    size = f"{rig.cam0.width}x{rig.cam0.height}, f {rig.cam0.fx:.1f} {rig.cam0.fy:.1f} px"
    click.echo(f"{out}: {provenance}: {size}, baseline {100 * rig.baseline:.2f} cm")
    click.echo("IMU noise: from the profile; measure it with `share calibrate imu`")
