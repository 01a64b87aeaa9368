"""`share calibrate camera`: intrinsics of one or two cameras, and the extrinsics of a pair."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.terminal import Stages, aligned_table
from share.errors import DataError, ShareError

if TYPE_CHECKING:
    from share.lab.calibrate.board_views import BoardImages
    from share.lab.calibrate.camera_report import CameraCalibration
    from share.lab.calibrate.corner_observations import BoardView
    from share.lab.calibrate.target import Target


@click.command()
@click.argument("source")
@options.target
@click.option(
    "--camera",
    type=click.Choice(["cam0", "both"]),
    default="both",
    help="cam0 alone, or both: cam0, cam1 and the extrinsics between them.",
)
@click.option("--every", type=click.IntRange(1), default=1, metavar="N", help="Use every N-th image.")
@click.option(
    "--views",
    "max_views",
    type=click.IntRange(4),
    default=60,
    metavar="N",
    help="Use the N most informative views.",
)
@click.option(
    "--lens",
    "model",
    type=click.Choice(["radtan", "equidistant"]),
    default="radtan",
    help="Lens model: radtan (radial-tangential), or equidistant (fisheye, Kannala and Brandt).",
)
@options.calib
@options.workers
@options.out_folder
@options.as_json
def camera(
    source: str,
    target_name: str,
    camera: str,
    every: int,
    max_views: int,
    model: str,
    calib: str | None,
    workers: int,
    out: Path,
    as_json: bool,
) -> None:
    """Estimate focal lengths, principal point, distortion and stereo extrinsics of one or two cameras.

    SOURCE is a recording of a calibration board, or a folder with cam0/*.png and cam1/*.png. The fifth
    coefficient of a radtan lens, k3, is estimated if the views determine it.

    Exit code 1 if the result is unreliable. If DIR holds an earlier result, that is kept, and the unreliable
    one is written as NAME.failed.EXT.

    \b
    Example:  share calibrate camera board.mcap --target aprilgrid --out calib/mine
              share calibrate camera pictures --target board.yaml --camera cam0 --out calib/mine
    """
    from share.files.writing import atomic_write, writable_dir
    from share.lab.calibrate import camera_report
    from share.lab.calibrate.board_views import open_board_images
    from share.lab.calibrate.camera_report import PICTURE, REPORT
    from share.lab.calibrate.report import failure_message, output_paths, to_json
    from share.lab.calibrate.target import named_target
    from share.recordings.calibration import CAMCHAIN, to_kalibr

    target = named_target(target_name)
    pictures = open_board_images(source, ("cam0", "cam1") if camera == "both" else ("cam0",), calib)
    if pictures.given_calibration is not None:
        to_kalibr(pictures.given_calibration.rig, pictures.given_calibration)  # check it before the work
    options.warn_other_device(source, pictures.given_calibration, pictures.serial)
    writable_dir(out, CAMCHAIN, REPORT, PICTURE)
    outcome = _calibrate(source, pictures, target, every, max_views, model, workers)
    text = to_json(camera_report.report_values(outcome))
    files = output_paths(out, outcome.verdict.passed, CAMCHAIN, REPORT, PICTURE)
    chain, report, picture = files
    atomic_write(chain, camera_report.camchain_yaml(outcome, source, report.name))
    atomic_write(report, text + "\n")
    camera_report.draw_residuals(picture, outcome, source)
    click.echo(text if as_json else _summary(outcome, files))
    if not outcome.verdict.passed:
        raise ShareError(f"{source}: {failure_message(chain, outcome.verdict.reasons)}")


def _find_board(
    source: str,
    pictures: BoardImages,
    target: Target,
    every: int,
    is_fisheye: bool,
    workers: int,
    stages: Stages,
) -> tuple[list[BoardView], list[tuple[int, int]]]:
    """Return the views with enough of the board, and the image size of each camera. Raises DataError where
    there is none, or the sizes differ."""
    from share.lab.calibrate.board_views import find_views
    from share.lab.calibrate.camera_initialisation import has_enough_corners

    progress = partial(stages, "looking for the board")
    views, sizes = find_views(pictures, target, every, progress, workers, is_fisheye)
    if len(set(sizes)) > 1:
        raise DataError(
            f"{source}: the cameras have images of different sizes, {sizes[0]} and {sizes[1]}; calibrate "
            "one with --camera cam0"
        )
    with_target = [
        view
        for view in views
        if any(has_enough_corners(target.corners[one.ids, :2]) for one in view.detections)
    ]
    if not with_target:
        raise DataError(
            f"{source}: no board found in {len(views)} images; check that --target is the board shown"
        )
    return with_target, sizes


def _calibrate(
    source: str, pictures: BoardImages, target: Target, every: int, max_views: int, model: str, workers: int
) -> CameraCalibration:
    from share.lab.calibrate.camera_bundle import calibrate_cameras
    from share.lab.calibrate.camera_report import CameraCalibration
    from share.lab.calibrate.camera_verdict import choose_views, coverage, judge_cameras, median_epipolar_px

    with Stages() as stages:
        is_fisheye = model == "equidistant"
        with_target, sizes = _find_board(source, pictures, target, every, is_fisheye, workers, stages)
        used = [with_target[k] for k in choose_views(with_target, target, sizes[0], max_views)]
        stages("calibrating", 0, 1)
        try:
            solution = calibrate_cameras(used, target, sizes[0], model)
        except ValueError as error:
            raise DataError(f"{source}: {error}") from None
        stages("calibrating", 1, 1)
    state, rig = solution.state, pictures.rig
    previous_px = None
    if len(sizes) == 2 and rig is not None and rig.cam1 is not None and rig.T_cam1_cam0 is not None:
        previous_px = median_epipolar_px(rig.cam0, rig.cam1, rig.T_cam1_cam0, with_target)
    covers = tuple(
        coverage([view.detections[cam].px for view in used], T, target, sizes[0])
        for cam, T in enumerate((state.T_cam0_target, state.T_cam1_cam0 @ state.T_cam0_target)[: len(sizes)])
    )
    return CameraCalibration(
        used,
        solution,
        covers,
        judge_cameras(solution, covers, with_target),
        rig,
        len(with_target),
        previous_px,
        pictures.given_calibration,
        pictures.serial,
    )


def _summary(outcome: CameraCalibration, files: tuple[Path, ...]) -> str:
    from share.lab.calibrate.camera_report import parameter_table

    verdict = outcome.verdict
    lines = [
        f"{len(outcome.views)} of {outcome.views_with_target} views with the board used",
        "",
        aligned_table(parameter_table(outcome)),
        "",
    ]
    for cam, cover in enumerate(outcome.coverages):
        lines.append(
            f"cam{cam}: {verdict.rms_px[cam]:.3f} px RMS, {verdict.rms_all_px[cam]:.3f} with its "
            f"{verdict.outlier_corners[cam]} outlier corners; corners cover {cover.share:.0%} of the image"
        )
        lines += [f"  {what}" for what in cover.gaps]
        if (radius := outcome.model_radius(cam)) is not None:
            lines.append(
                f"  most corners beyond {radius:.0f} px from the principal point do not fit the lens model"
            )
    if verdict.epipolar_px is not None:
        previous_text = (
            ""
            if outcome.previous_epipolar_px is None
            else f" ({outcome.previous_epipolar_px:.3f} px with the previous calibration)"
        )
        lines.append(
            f"stereo pair: median distance to the epipolar line {verdict.epipolar_px:.3f} px{previous_text}"
        )
    if verdict.outlier_views:
        names = ", ".join(outcome.views[k].name for k in verdict.outlier_views[:6])
        more = ", …" if len(verdict.outlier_views) > 6 else ""
        lines.append(f"{len(verdict.outlier_views)} views fit worse than the others: {names}{more}")
    return "\n".join([*lines, f"{files[0].parent}: {', '.join(path.name for path in files)}"])
