"""`share calibrate mocap`: where a motion capture's rigid body is on a device, and its clock offset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.terminal import Stages, print_note
from share.errors import UsageError

if TYPE_CHECKING:
    from share.lab.calibrate.handeye import HandEyeCheck
    from share.lab.mocap.fit import MocapFit
    from share.lab.mocap.trajectory import MocapTrajectory


@click.command()
@click.argument("source")
@click.option(
    "--mocap",
    "--truth",
    "truth",
    required=True,
    metavar="FILE",
    type=options.PATH,
    help="Motion capture file: Vicon's or Motive's CSV, TUM, or CSV with t[ns], x y z, qw qx qy qz.",
)
@click.option(
    "--body",
    metavar="BODY",
    help="Rigid body in that file.  [default: the one with the source's name, or the only one]",
)
@options.rotations
@click.option(
    "--calib",
    metavar="FILE",
    help="The IMU's noise: kalibr_imu_chain.yaml by share calibrate imu, or its folder.  [default: SOURCE's]",
)
@click.option(
    "--track",
    metavar="T.tum",
    type=options.PATH,
    help="Poses of the device by share track, to check the result.",
)
@click.option("--one-clock", is_flag=True, help="Device and motion capture share one clock.")
@click.option(
    "--within",
    "max_offset_s",
    type=click.FloatRange(min=0.01),
    default=0.5,
    metavar="S",
    help="Largest clock offset to search, s.",
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
    max_offset_s: float,
    sigma_mm: float,
    out: Path,
    as_json: bool,
) -> None:
    """Estimate the pose of a motion capture's body in the IMU frame, the tilt of its world, and the offset
    and drift of its clock.

    SOURCE and --mocap are recordings of the same motion, about a minute long.

    \b
    Example:  share calibrate mocap walk.mcap --mocap walk.vicon.tum --out calib/mine
    """
    from share.files.writing import atomic_write, writable_dir
    from share.lab.calibrate.imu_table import read_imu, stated_noise
    from share.lab.calibrate.report import to_json
    from share.lab.mocap.files import pick_body, read_bodies
    from share.lab.mocap.fit import fit_mocap
    from share.lab.mocap.report import mocap_yaml, report_values
    from share.lab.mocap.state import MocapFitOptions
    from share.lab.mocap.verdict import check_fit, fit_warnings

    fit_options = MocapFitOptions(sigma_position=sigma_mm * 1e-3, within_s=max_offset_s)
    if one_clock:
        fit_options = replace(fit_options, within_s=0.0, offset_sigma=1e-5, drift_sigma=1e-8)
    noise, bodies = stated_noise(source, calib, "--calib"), read_bodies(truth, rotations)
    _, trajectory = pick_body(str(truth), bodies, body, Path(source).stem, "--body BODY")
    writable_dir(out, "mocap.yaml", "mocap-report.json")
    with Stages() as stages:
        table = read_imu(source, lambda done, total: stages("reading", done, total))
        stages("fitting", 0, 1)
        result = fit_mocap(table.imu, noise, trajectory, fit_options)
        check_fit(result)
        stages("fitting", 1, 1)
    hand_eye_check = _check_with_track(result, track, trajectory) if track else None
    report = to_json(report_values(result, source, str(truth), hand_eye_check))
    atomic_write(out / "mocap.yaml", mocap_yaml(result, source, str(truth)))
    atomic_write(out / "mocap-report.json", report + "\n")
    click.echo(report if as_json else _summary(result, hand_eye_check))
    for warning in fit_warnings(result):
        print_note(source, warning)
    if hand_eye_check and not hand_eye_check.agrees:
        click.echo(f"share: {track} contradicts the fit; check that it is of this recording", err=True)


def _check_with_track(result: MocapFit, track: Path, trajectory: MocapTrajectory) -> HandEyeCheck:
    from share.lab.calibrate.handeye import check_mounting
    from share.recordings.trajectory import read_tum

    if not track.is_file():
        raise UsageError(f"--track {track}: no such file")
    track_poses, shifted = read_tum(track), trajectory.shifted(result.offset_ns)
    is_known = shifted.is_covered(track_poses.stamps_ns)
    stamps = track_poses.stamps_ns[is_known]
    return check_mounting(result.T_body_mocap, stamps, track_poses.T[is_known], shifted.interpolate(stamps))


def _summary(result: MocapFit, hand_eye_check: HandEyeCheck | None) -> str:
    import numpy as np

    from share.geometry import se3
    from share.lab.calibrate.report import cells_with_sigmas
    from share.lab.mocap.verdict import shared_sigmas

    T, residuals, sigma = result.T_body_mocap, result.residuals, shared_sigmas(result)
    turn_deg, turn_sigma = np.degrees(se3.so3_log(T[:3, :3])), np.degrees(sigma[2:5])
    rotation = "  ".join(cells_with_sigmas(turn_deg, turn_sigma, 2))
    position = "  ".join(cells_with_sigmas(T[:3, 3] * 1e3, sigma[5:8] * 1e3, 1))
    lines = [
        f"body rotation   {rotation} deg (rotation vector)",
        f"body position   {position} mm, in the IMU frame",
        f"world tilt      {result.tilt_deg:.3f} ± {np.degrees(sigma[:2].max()):.3f} deg, up axis {result.up}",
        f"clock           IMU minus mocap {result.offset_ns * 1e-6:+.2f} ± {sigma[8] * 1e3:.2f} ms, "
        f"drift {result.drift_ppm:+.1f} ± {sigma[9] * 1e6:.1f} ppm",
        f"residuals       {residuals.position_mm:.1f} mm, {residuals.rotation_deg:.2f} deg rms of "
        f"{residuals.samples} poses, {100 * residuals.outlier_share:.1f} % outliers",
    ]
    if hand_eye_check:
        lines.append(
            f"hand-eye        differs by {np.degrees(hand_eye_check.rotation_error_rad):.2f} deg and "
            f"{hand_eye_check.translation_error_m * 1e3:.1f} mm, {hand_eye_check.sigmas:.1f} standard errors"
        )
    return "\n".join(lines)
