"""`share calibrate headset`: the pose of a headset's viewer on the device it carries, and its clock."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.terminal import print_note
from share.errors import UsageError

if TYPE_CHECKING:
    from share.lab.calibrate.headset import HeadsetMount
    from share.lab.mocap.trajectory import MocapTrajectory


@click.command()
@click.argument("device", type=options.PATH)
@click.argument("headset", type=options.PATH)
@options.out_folder
@options.as_json
def headset(device: Path, headset: Path, out: Path, as_json: bool) -> None:
    """Estimate where a headset's own tracking sits on a device's body, and the offset of their clocks.

    DEVICE and HEADSET are TUM files of half a minute in which the wearer nods, tilts the head and looks
    around: odom.tum by share agent --out, and the headset's poses in its own space.

    \b
    Example:  share calibrate headset out/ann/odom.tum quest.tum --out calib/mine
    """
    from share.files.writing import atomic_write, writable_dir
    from share.lab.calibrate.headset import fit_mount, mount_warnings, moved_warning
    from share.lab.calibrate.headset_report import HEADSET_FILE, headset_yaml, report_values
    from share.lab.calibrate.report import to_json

    device_poses, headset_poses = _poses(device), _poses(headset)
    writable_dir(out, HEADSET_FILE, "headset-report.json")
    mount = fit_mount(device_poses, headset_poses)
    moved = moved_warning(device_poses, headset_poses, mount)
    warnings = mount_warnings(mount) + ([moved] if moved else [])
    report = to_json(report_values(mount, str(device), str(headset), warnings))
    atomic_write(out / HEADSET_FILE, headset_yaml(mount, str(device), str(headset)))
    atomic_write(out / "headset-report.json", report + "\n")
    click.echo(report if as_json else _summary(mount))
    for warning in warnings:
        print_note(str(headset), warning)


def _poses(path: Path) -> MocapTrajectory:
    from share.lab.mocap.trajectory import MocapTrajectory
    from share.recordings.losses import DataLosses
    from share.recordings.trajectory import read_tum

    if not path.exists():
        raise UsageError(f"{path}: no such file")
    losses = DataLosses()
    stamps_ns, T = read_tum(path, losses)
    for line in losses.lines():
        print_note(str(path), line)
    return MocapTrajectory(stamps_ns, T, source=str(path))


def _summary(mount: HeadsetMount) -> str:
    import numpy as np

    from share.geometry import se3
    from share.lab.calibrate.report import cells_with_sigmas

    T, sigma = mount.T_body_viewer, mount.sigmas
    rotation = "  ".join(cells_with_sigmas(np.degrees(se3.so3_log(T[:3, :3])), np.degrees(sigma[:3]), 2))
    position = "  ".join(cells_with_sigmas(T[:3, 3] * 1e3, sigma[3:6] * 1e3, 1))
    turned = ", ".join(f"{angle:.0f}" for angle in np.degrees(mount.rotation_rms_by_axis))
    return "\n".join(
        [
            f"viewer rotation  {rotation} deg (rotation vector)",
            f"viewer position  {position} mm, in the body's frame",
            f"clock            device minus headset {mount.offset_ns * 1e-6:+.2f} ± {sigma[6] * 1e3:.2f} ms",
            f"residuals        {mount.translation_rms * 1e3:.1f} mm, {np.degrees(mount.rotation_rms):.2f} "
            f"deg rms of {mount.motions} motions over a second, in {mount.duration_s:.0f} s",
            f"turned by        {turned} deg rms about the three principal axes within a second",
        ]
    )
