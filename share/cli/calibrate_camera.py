"""`share calibrate camera`: intrinsics of one or two cameras, and how they sit to each other."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.progress import Stages
from share.cli.table import aligned
from share.errors import DataError, ShareError

if TYPE_CHECKING:
    from share.lab.calibrate.board_views import Pictures
    from share.lab.calibrate.camera_report import Outcome
    from share.lab.calibrate.target import Target


@click.command(short_help="Intrinsics of one or two cameras from views of a board.")
@click.argument("source")
@options.target
@click.option("--camera", type=click.Choice(["cam0", "both"]), default="both", show_default=True)
@click.option(
    "--every", type=click.IntRange(1), default=1, show_default=True, metavar="N",
    help="Look at each N-th picture.",
)  # fmt: skip
@click.option(
    "--views", "most", type=click.IntRange(4), default=60, show_default=True, metavar="N",
    help="Use the N views that together tell most.",
)  # fmt: skip
@click.option(
    "--lens", "model", type=click.Choice(["radtan", "equidistant"]), default="radtan", show_default=True,
    help="Radial-tangential, or the fisheye model of Kannala and Brandt.",
)  # fmt: skip
@options.calib
@options.workers
@options.out_folder
@options.as_json
def camera(
    source: str,
    target_name: str,
    camera: str,
    every: int,
    most: int,
    model: str,
    calib: str | None,
    workers: int,
    out: Path,
    as_json: bool,
) -> None:
    """Find focal lengths, principal point and distortion of a camera or a stereo pair, and how the pair sits,
    from a recording of a calibration board or a folder with cam0/*.png and cam1/*.png.

    A radtan lens has its fifth coefficient, k3, where the views tell it.
    Exit code 1 where the result is not to be believed; the files are written all the same. A camchain and a
    report that are in DIR are then kept.

    \b
    Example:  share calibrate camera board.mcap --target aprilgrid --out calib/mine
              share calibrate camera pictures --target board.yaml --camera cam0 --out calib/mine
    """
    from share.files.json_file import known
    from share.files.writing import atomic_write, writable_dir
    from share.lab.calibrate import camera_report
    from share.lab.calibrate.board_views import open_pictures
    from share.lab.calibrate.camera_report import PICTURE, REPORT, places, written
    from share.lab.calibrate.target import named_target
    from share.recordings.calibration import CAMCHAIN, to_kalibr

    target = named_target(target_name)
    pictures = open_pictures(source, ("cam0", "cam1") if camera == "both" else ("cam0",), calib)
    if pictures.said is not None:
        to_kalibr(pictures.said.rig, pictures.said)  # what is kept of it must be sound: said before the work
    options.say_another(source, pictures.said, pictures.serial)
    writable_dir(out, CAMCHAIN, REPORT, PICTURE)
    outcome = _calibrated(source, pictures, target, every, most, model, workers)
    text = json.dumps(known(camera_report.to_json(outcome)), indent=1)
    files = places(out, outcome.verdict.passed, CAMCHAIN, REPORT, PICTURE)
    chain, report, picture = files
    atomic_write(chain, camera_report.kalibr_text(outcome, source, report.name))
    atomic_write(report, text + "\n")
    atomic_write(picture, camera_report.picture(outcome, source))
    click.echo(text if as_json else _summary(outcome, files))
    if not outcome.verdict.passed:
        raise ShareError(
            f"{source}: not to be believed ({written(chain)}): " + "; ".join(outcome.verdict.reasons)
        )


def _calibrated(
    source: str, pictures: Pictures, target: Target, every: int, most: int, model: str, workers: int
) -> Outcome:
    from share.lab.calibrate.board_views import find_views
    from share.lab.calibrate.camera_bundle import calibrate
    from share.lab.calibrate.camera_report import Outcome
    from share.lab.calibrate.camera_start import enough
    from share.lab.calibrate.camera_verdict import choose, coverage, judge, typical_miss

    with Stages() as stages:
        views, sizes = find_views(
            pictures, target, every, partial(stages, "looking for the board"), workers, model == "equidistant"
        )
        if len(set(sizes)) > 1:
            raise DataError(
                f"{source}: pictures of {sizes[0]} and {sizes[1]}; calibrate one with --camera cam0"
            )
        seen = [view for view in views if any(enough(target.corners[one.ids, :2]) for one in view.seen)]
        if not seen:
            raise DataError(
                f"{source}: no board in {len(views)} pictures; is --target the board that was shown?"
            )
        used = [seen[k] for k in choose(seen, target, sizes[0], most)]
        stages("calibrating", 0, 1)
        try:
            solution = calibrate(used, target, sizes[0], model)
        except ValueError as error:
            raise DataError(f"{source}: {error}") from None
        stages("calibrating", 1, 1)
    state, rig = solution.state, pictures.rig
    before = None
    if len(sizes) == 2 and rig is not None and rig.cam1 is not None and rig.T_cam1_cam0 is not None:
        before = typical_miss(rig.cam0, rig.cam1, rig.T_cam1_cam0, seen)
    covers = tuple(
        coverage([view.seen[eye].px for view in used], T, target, sizes[0])
        for eye, T in enumerate((state.T_cam0_target, state.T_cam1_cam0 @ state.T_cam0_target)[: len(sizes)])
    )
    return Outcome(
        used, solution, covers, judge(solution, covers, seen), rig, len(seen), before, pictures.said,
        pictures.serial,
    )  # fmt: skip


def _summary(outcome: Outcome, files: tuple[Path, ...]) -> str:
    from share.lab.calibrate.camera_report import table

    verdict = outcome.verdict
    lines = [
        f"{len(outcome.views)} views of {outcome.seen} that show the board",
        "",
        aligned(table(outcome)),
        "",
    ]
    for eye, cover in enumerate(outcome.covers):
        lines.append(
            f"cam{eye}: {verdict.rms_px[eye]:.3f} px RMS, {verdict.rms_all_px[eye]:.3f} with the "
            f"{verdict.wrong[eye]} corners that are left out; "
            f"corners in {cover.share:.0%} of the image"
        )
        lines += [f"  {what}" for what in cover.missing]
        if (radius := outcome.reach(eye)) is not None:
            lines.append(
                f"  most corners beyond {radius:.0f} px of the principal point do not fit: there the lens is "
                "not of this model"
            )
    if verdict.pair_px is not None:
        was = (
            "" if outcome.pair_before_px is None else f" ({outcome.pair_before_px:.3f} px by the one before)"
        )
        lines.append(
            f"the pair: half of the corners within {verdict.pair_px:.3f} px of their epipolar line{was}"
        )
    if verdict.outliers:
        names = ", ".join(outcome.views[k].name for k in verdict.outliers[:6])
        more = ", …" if len(verdict.outliers) > 6 else ""
        lines.append(f"{len(verdict.outliers)} views fit worse than the rest: {names}{more}")
    return "\n".join([*lines, f"{files[0].parent}: {', '.join(path.name for path in files)}"])
