"""`share calibrate camera-imu`: extrinsics of cameras and IMU, and the offset of their clocks."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.terminal import Stages, aligned_table, print_note
from share.errors import DataError, ShareError

if TYPE_CHECKING:
    from share.geometry.camera import ImuNoise
    from share.lab.calibrate.board_views import RigImages
    from share.lab.calibrate.camera_imu.verdict import MountingComparison
    from share.lab.calibrate.camera_imu_report import CameraImuCalibration
    from share.types import F64

_WARN_NOISE_RATIO = 2.0  # residuals above this many times the stated noise give a warning


@click.command("camera-imu")
@click.argument("source")
@options.target
@click.option(
    "--camera",
    metavar="CALIB.yaml",
    help="The cameras: a camchain file by share calibrate camera, or its folder.  [default: SOURCE's]",
)
@click.option(
    "--imu",
    metavar="IMU.yaml",
    help="The IMU's noise: a file by share calibrate imu, or its folder.  [default: SOURCE's]",
)
@click.option("--every", type=click.IntRange(1), default=1, metavar="N", help="Use every N-th image.")
@click.option(
    "--within",
    "max_offset_s",
    type=click.FloatRange(0.01, 1.0),
    default=0.5,
    metavar="S",
    help="Largest time offset to search, s.",
)
@options.workers
@options.out_folder
@options.as_json
def camera_imu(
    source: str,
    target_name: str,
    camera: str | None,
    imu: str | None,
    every: int,
    max_offset_s: float,
    workers: int,
    out: Path,
    as_json: bool,
) -> None:
    """Estimate T_cam_imu of each camera and the time offset between camera and IMU.

    SOURCE is a recording of about a minute in which the rig was rotated and moved before a calibration board.

    Exit code 1 if the result is unreliable. If DIR holds an earlier result, that is kept, and the unreliable
    one is written as NAME.failed.EXT. An IMU chain in DIR is always kept.

    \b
    Example:  share calibrate camera-imu dance.mcap --target board.yaml --camera calib/mine \\
                --imu calib/mine --out calib/mine
    """
    from share.files.writing import atomic_write, writable_dir
    from share.lab.calibrate import camera_imu_report as report
    from share.lab.calibrate.board_views import open_rig_images
    from share.lab.calibrate.imu_table import stated_noise
    from share.lab.calibrate.report import failure_message, output_paths, to_json
    from share.recordings.calibration import CAMCHAIN, IMU_CHAIN

    pictures = open_rig_images(source, camera)
    noise = stated_noise(source, imu, "--imu")
    options.warn_other_device(source, pictures.images.given_calibration, pictures.images.serial)
    writable_dir(out, CAMCHAIN, IMU_CHAIN, report.REPORT, report.PICTURE)
    outcome = _calibrate(source, pictures, noise, target_name, every, max_offset_s, workers)
    text = to_json(report.report_values(outcome))
    verdict = "passed" if outcome.verdict.passed else "FAILED"
    chain, report_file, picture = output_paths(
        out, outcome.verdict.passed, CAMCHAIN, report.REPORT, report.PICTURE
    )
    imu_chain = out / IMU_CHAIN
    atomic_write(chain, report.camchain_yaml(outcome, source, report_file.name))
    warnings = [*_warnings(outcome), *_write_imu_chain(imu_chain, imu, source, noise, outcome)]
    atomic_write(report_file, text + "\n")
    report.draw_residuals(picture, outcome.fit, f"{source}: {verdict}")
    click.echo(text if as_json else _summary(outcome, (chain, imu_chain, report_file, picture)))
    for warning in warnings:
        print_note(source, warning)
    if not outcome.verdict.passed:
        raise ShareError(f"{source}: {failure_message(chain, outcome.verdict.reasons)}")


def _write_imu_chain(
    path: Path, imu: str | None, source: str, noise: ImuNoise, outcome: CameraImuCalibration
) -> list[str]:
    """Write the noise that was used, unless there is an IMU chain; return a warning if that has another."""
    from share.files.writing import atomic_write
    from share.files.yaml_file import read_yaml_text
    from share.lab.calibrate.camera_imu_report import imu_chain_yaml
    from share.lab.calibrate.camera_report import has_noise
    from share.lab.calibrate.imu_table import chain_file

    if not path.exists():
        as_given = None if imu is None else read_yaml_text(chain_file(imu, "--imu"))
        atomic_write(path, as_given or imu_chain_yaml(outcome, source))
    elif not has_noise(path, noise):
        used = "the recording's" if imu is None else f"that of --imu {imu}"
        return [
            f"{path} has other noise than was used ({used}) and is kept; to use it, give --imu {path.parent}"
        ]
    return []


def _calibrate(
    source: str,
    pictures: RigImages,
    noise: ImuNoise,
    target_name: str,
    every: int,
    max_offset_s: float,
    workers: int,
) -> CameraImuCalibration:
    from share.lab.calibrate.board_views import find_stamped_views
    from share.lab.calibrate.camera_imu.fit import fit_camera_imu
    from share.lab.calibrate.camera_imu.verdict import compare_mountings, judge_camera_imu
    from share.lab.calibrate.camera_imu_report import CameraImuCalibration
    from share.lab.calibrate.imu_table import read_imu
    from share.lab.calibrate.target import named_target

    target = named_target(target_name)
    with Stages() as stages:
        table = read_imu(source, partial(stages, "reading the IMU"))
        if not len(table.imu):
            raise DataError(f"{source}: no IMU samples in the recording")
        views = find_stamped_views(pictures, target, every, partial(stages, "looking for the board"), workers)
        result = fit_camera_imu(
            views.stamps,
            views.views,
            target,
            pictures.rig,
            table.imu,
            noise,
            max_offset_s,
            partial(stages, "fitting"),
            pictures.uncertainty.covariance,
        )
    comparison = (
        None
        if pictures.given_T_imu_cam0 is None
        else compare_mountings(result.T_imu_cam0, pictures.given_T_imu_cam0)
    )
    images = pictures.images
    return CameraImuCalibration(
        result,
        judge_camera_imu(result),
        pictures.rig,
        pictures.uncertainty,
        noise,
        comparison,
        views,
        images.given_calibration,
        images.serial,
    )


def _summary(outcome: CameraImuCalibration, files: tuple[Path, ...]) -> str:
    import numpy as np

    from share.geometry import se3
    from share.lab.calibrate.report import cells_with_sigmas

    fit, verdict = outcome.fit, outcome.verdict
    rotation_deg = np.degrees(se3.so3_log(fit.T_imu_cam0[:3, :3]))
    rows = [
        ["", "", "x", "y", "z"],
        ["rotation of cam0", "deg", *cells_with_sigmas(rotation_deg, np.degrees(fit.sigma_rotation), 3)],
        [
            "position of cam0",
            "mm",
            *cells_with_sigmas(fit.T_imu_cam0[:3, 3] * 1e3, fit.sigma_position * 1e3, 2),
        ],
    ]
    shift = f"{fit.shift_s * 1e3:+.3f} ± {fit.sigma_shift * 1e3:.3f} ms"
    lines = [
        f"{outcome.views.with_target} of {outcome.views.images_searched} images show the board, "
        f"{fit.state.curve.end_s:.1f} s",
        "",
        aligned_table(rows),
        "in the IMU's frame (rotation vector); ± one sigma",
        "",
        f"time offset: {shift} (t_imu = t_cam + offset)",
        _camera_sigmas_text(outcome),
        *(
            f"cam{cam}: {rms:.3f} px RMS, {wrong} of {len(r)} corners are outliers"
            for cam, (rms, wrong, r) in enumerate(
                zip(verdict.rms_px, verdict.outlier_corners, fit.corners, strict=True)
            )
        ),
        f"gyroscope: residuals {verdict.gyro_noise_ratio:.2f} times the stated noise; rotation rate "
        f"{_comma_list(verdict.rotation_rate_rms)} rad/s rms",
        f"accelerometer: residuals {verdict.accel_noise_ratio:.2f} times the stated noise; acceleration "
        f"{_comma_list(verdict.acceleration_rms)} m/s^2 rms; "
        f"gravity {np.linalg.norm(fit.state.gravity):.4f} m/s^2",
        f"{files[0].parent}: {', '.join(path.name for path in files)}",
    ]
    return "\n".join(lines)


def _camera_sigmas_text(outcome: CameraImuCalibration) -> str:
    """Return how much of the sigmas comes from the uncertainty of the camera calibration."""
    from share.lab.calibrate.camera_imu.verdict import largest_sigmas

    fit, uncertainty = outcome.fit, outcome.uncertainty
    if fit.by_rig is None:
        return f"cameras: taken as exact; the sigmas do not include their errors ({uncertainty.source})"
    deg, mm, ms = largest_sigmas(fit.axis_sigmas(fit.by_rig))
    return (
        f"cameras: uncertainty of {uncertainty.source}; it contributes up to {deg:.3f} deg, {mm:.2f} mm, "
        f"{ms:.3f} ms to the sigmas"
    )


def _comma_list(values: F64) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


def _warnings(outcome: CameraImuCalibration) -> list[str]:
    """Return warnings about the result, one per line."""
    verdict = outcome.verdict
    out = _comparison_warnings(outcome.comparison)
    if not outcome.uncertainty.passed:
        out.append(f"{outcome.uncertainty.source} calls these cameras unreliable; calibrate them again first")
    if dropped := outcome.views.dropped:
        out.append(f"{dropped} images of the board were skipped: their stamps do not increase")
    return out + [
        f"{name} residuals are {times:.1f} times the stated noise (scale, axes or the board's size may be "
        "wrong); the sigmas are scaled accordingly"
        for name, times in (
            ("gyroscope", verdict.gyro_noise_ratio),
            ("accelerometer", verdict.accel_noise_ratio),
        )
        if times > _WARN_NOISE_RATIO and verdict.passed
    ]


def _comparison_warnings(comparison: MountingComparison | None) -> list[str]:
    """Return warnings about the difference to the calibration that was given."""
    if comparison is None:
        return []
    if comparison.inverted:
        return [
            "the given extrinsics are inverted: T_cam_imu holds T_imu_cam, or the reverse; the new file is "
            "right"
        ]
    if comparison.is_far:
        return [
            f"cam0 is {comparison.translation_mm:.0f} mm and {comparison.rotation_deg:.1f} deg from its pose "
            "in the given calibration"
        ]
    return []
