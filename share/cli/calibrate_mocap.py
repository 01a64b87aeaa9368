"""`share calibrate mocap`: how a motion capture's body sits on a device."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.progress import Stages
from share.errors import UsageError

if TYPE_CHECKING:
    from share.lab.calibrate.handeye import Check
    from share.lab.mocap.fit import Fit
    from share.lab.mocap.mocap import Mocap
    from share.types import F64


@click.command(short_help="How a motion capture's body sits on a device, and its clock.")
@click.argument("source")
@click.option(
    "--truth",
    required=True,
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="What the motion capture saw: Vicon's or Motive's CSV, TUM, or CSV with t[ns], x y z, qw qx qy qz.",
)
@click.option(
    "--body",
    metavar="BODY",
    help="Which rigid body of the file.  [default: the one of the source's name, or the only one]",
)
@options.rotations
@click.option(
    "--calib",
    metavar="FILE",
    help="The IMU's noise, by share calibrate imu: kalibr_imu_chain.yaml, or a folder with it; overrides "
    "what the source carries.",
)
@click.option(
    "--track",
    metavar="T.tum",
    type=click.Path(path_type=Path),
    help="Poses of the device by share track, to check with.",
)
@click.option("--one-clock", is_flag=True, help="Both were stamped by one clock.")
@click.option(
    "--within",
    type=click.FloatRange(min=0.01),
    default=0.5,
    show_default=True,
    metavar="S",
    help="How far apart the clocks may be, s.",
)
@options.sigma_mm
@options.out_folder
@options.as_json
def mocap(
    source: str,
    truth: Path,
    body: str | None,
    rotations: str,
    calib: str | None,
    track: Path | None,
    one_clock: bool,
    within: float,
    sigma_mm: float,
    out: Path,
    as_json: bool,
) -> None:
    """Find where a motion capture's body sits on the IMU, how far its world is from level, and how far its
    clock from the device's, from a minute of motion that both recorded.

    \b
    Example:  share calibrate mocap walk.mcap --truth walk.vicon.tum --out calib/mine
    """
    from share.files.json_file import known
    from share.files.writing import atomic_write, writable_dir
    from share.lab.calibrate.imu_table import read_imu, stated_noise
    from share.lab.mocap.files import pick_body, read_bodies
    from share.lab.mocap.fit import fit
    from share.lab.mocap.report import mocap_json, mocap_text
    from share.lab.mocap.state import FitOptions
    from share.lab.mocap.verdict import check_fit, doubts

    chosen = FitOptions(sigma_position=sigma_mm * 1e-3, within_s=within)
    if one_clock:
        chosen = replace(chosen, within_s=0.0, offset_sigma=1e-5, drift_sigma=1e-8)
    noise, bodies = stated_noise(source, calib, "--calib"), read_bodies(truth, rotations)
    _, seen = pick_body(str(truth), bodies, body, Path(source).stem, "--body BODY")
    writable_dir(out, "mocap.yaml", "mocap-report.json")
    with Stages() as stages:
        table = read_imu(source, lambda done, total: stages("reading", done, total))
        stages("fitting", 0, 1)
        found = fit(table.imu, noise, seen, chosen)
        check_fit(found)
        stages("fitting", 1, 1)
    checked = _check(found, track, seen) if track else None
    report = json.dumps(known(mocap_json(found, source, str(truth), checked)), indent=1)
    atomic_write(out / "mocap.yaml", mocap_text(found, source, str(truth)))
    atomic_write(out / "mocap-report.json", report + "\n")
    click.echo(report if as_json else _summary(found, checked))
    for doubt in doubts(found):
        click.echo(f"share: {source}: {doubt}", err=True)
    if checked and not checked.agrees:
        click.echo(f"share: {track}: does not agree with the fit; is it of this recording?", err=True)


def _check(found: Fit, track: Path, seen: Mocap) -> Check:
    from share.lab.calibrate.handeye import check
    from share.recordings.trajectory import read_tum

    if not track.is_file():
        raise UsageError(f"--track {track}: no such file")
    own, shifted = read_tum(track), seen.shifted(found.offset_ns)
    both = shifted.known(own.stamps_ns)
    stamps = own.stamps_ns[both]
    return check(found.T_body_mocap, stamps, own.T[both], shifted.at(stamps))


def _summary(found: Fit, checked: Check | None) -> str:
    import numpy as np

    from share.geometry import se3
    from share.lab.mocap.verdict import sigmas

    T, left, sigma = found.T_body_mocap, found.residuals, sigmas(found)
    turn = np.degrees(se3.so3_log(T[:3, :3]))
    lines = [
        f"body rotation   {_triple(turn, np.degrees(sigma[2:5]), 2)} deg (rotation vector)",
        f"body position   {_triple(T[:3, 3] * 1e3, sigma[5:8] * 1e3, 1)} mm, in the IMU's frame",
        f"world tilt      {found.tilt_deg:.3f} ± {np.degrees(sigma[:2].max()):.3f} deg, its {found.up} up",
        f"clock           IMU's less mocap's {found.offset_ns * 1e-6:+.2f} ± {sigma[8] * 1e3:.2f} ms, "
        f"drift {found.drift_ppm:+.1f} ± {sigma[9] * 1e6:.1f} ppm",
        f"left            {left.position_mm:.1f} mm, {left.rotation_deg:.2f} deg rms of {left.samples} "
        f"poses, {100 * left.doubted:.1f} % doubted",
    ]
    if checked:
        lines.append(
            f"hand-eye        by the track: {np.degrees(checked.turned):.2f} deg and "
            f"{checked.shifted * 1e3:.1f} mm from that, {checked.sigmas:.1f} standard errors"
        )
    return "\n".join(lines)


def _triple(values: F64, errors: F64, digits: int) -> str:
    return "  ".join(f"{v:+.{digits}f} ± {e:.{digits}f}" for v, e in zip(values, errors, strict=True))
