"""`share train`: train the model that estimates the tracking error, from recordings with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from share.cli import options
from share.cli.commands import CommandGroup
from share.cli.terminal import LiveLine
from share.errors import UsageError, install_hint

if TYPE_CHECKING:
    from share.types import F32

_BASE_OPTION = click.option(
    "--base",
    metavar="FILE",
    type=options.EXISTING_FILE,
    help="Take the backbone of this model.  [default: the one shipped with SHARE]",
)


@click.group(cls=CommandGroup, prefix="train ")
def train() -> None:
    """Train the error model, which estimates the tracking error of a keyframe.

    \b
    Example:  share emulate --scene warehouse --motion ar=walk: --seconds 30 --seed 1 --out rooms/w1
              share train labels rooms/* --runs 4 --out labels
              share train fit labels --out fit
              share train export fit --labels labels --out error_model.onnx
    """


@train.command(short_help="Run the tracker over sessions and record its errors.")
@click.argument("sessions", nargs=-1, required=True, type=options.PATH)
@click.option(
    "--runs",
    type=click.IntRange(1, 1000),
    default=4,
    help="Runs per agent: one as recorded, the others degraded (dark, blurred, frames missing, …).",
)
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of the degradation.")
@click.option("--without-imu", is_flag=True, help="Ignore the IMU: stereo or depth only.")
@click.option("--workers", type=click.IntRange(1, 64), default=2, help="Runs in parallel.")
@options.config
@click.option(
    "--out", required=True, metavar="DIR", type=options.PATH, help="Output folder; gets a file per run."
)
def labels(
    sessions: tuple[Path, ...],
    runs: int,
    seed: int,
    without_imu: bool,
    workers: int,
    config_file: Path | None,
    out: Path,
) -> None:
    """Run the tracker over each agent of SESSIONS, as recorded and degraded; write the inputs of the error
    model and the true error of each keyframe.

    The error is that of the positions of the last 5 s after SE3 alignment to the ground truth, rms, cm. Runs
    already in DIR are kept, so an interrupted command continues when it is run again.

    \b
    Example:  share train labels rooms/* --runs 8 --out labels
    """
    config, live = options.load_config(config_file), LiveLine()
    from share.files.writing import writable_dir
    from share.lab.train.labels import make_labels, plan_label_runs
    from share.recordings.session import read_session

    jobs = plan_label_runs([read_session(folder) for folder in sessions], runs, seed, not without_imu, out)
    writable_dir(out)
    errors = []  # the errors only: the pictures of hundreds of runs would fill the memory
    for job, run_labels in make_labels(jobs, config, workers):
        errors.append(run_labels.error_cm)
        live.write(f"{len(errors)} of {len(jobs)} runs: {job.out.name}, {len(run_labels)} keyframes")
    live.end()
    click.echo(_summary(errors))
    click.echo(f"labels: {out}")


@train.command(short_help="Train the error model on labels.")
@click.argument("labels", metavar="LABELS", type=options.PATH)
@click.option("--epochs", type=click.IntRange(1), default=200, help="Largest number of epochs.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of the split and the training.")
@_BASE_OPTION
@options.out_folder
def fit(labels: Path, epochs: int, seed: int, base: Path | None, out: Path) -> None:
    """Train the head of the error model on LABELS, a folder by `share train labels`: minutes on a CPU; a GPU
    is used if there is one. Rooms are split into training, early stopping, calibration of intervals and test.

    An interrupted command continues when it is run again. Needs `pip install share-slam[train]`.

    \b
    Example:  share train fit labels --out fit
              share train export fit --labels labels --out error_model.onnx
    """
    _check_train_extra()
    from share.files.writing import writable_dir
    from share.lab.train.keyframe_table import collect_labels
    from share.lab.train.network import backbone_id
    from share.lab.train.trained_heads import write_trained
    from share.lab.train.training import TrainingOptions, train_model
    from share.odometry.error_model.network import backbone_features, open_network, read_model

    collection, live = collect_labels(labels, seed), LiveLine()
    base_model = read_model(_base_model_file(base))
    writable_dir(out)
    live.write(f"computing backbone features of {len(collection.table.error_cm)} images")
    deep_features = backbone_features(open_network(base_model), collection.table.picture)

    def show(epoch: int, training_loss: float, stopping_loss: float) -> None:
        live.write(f"epoch {epoch}: training loss {training_loss:.4f}, stopping loss {stopping_loss:.4f}")

    fit_options = TrainingOptions(epochs=epochs, seed=seed)
    backbone = backbone_id(base_model)
    fitted = train_model(collection, deep_features, backbone, fit_options, out / "checkpoint.pt", show)
    live.end()
    write_trained(out / "fit.npz", fitted)
    counts = ", ".join(f"{count} to {part}" for part, count in fitted.about["keyframes"].items())
    click.echo(f"keyframes: {counts}")
    click.echo(f"fit: {out / 'fit.npz'}")


@train.command(short_help="Write the trained model and its model card.")
@click.argument("fitted", metavar="FIT", type=options.PATH)
@click.option(
    "--labels", required=True, metavar="LABELS", type=options.PATH, help="The labels it was trained on."
)
@_BASE_OPTION
@click.option("--out", required=True, metavar="FILE", type=options.PATH, help="ONNX file to write.")
def export(fitted: Path, labels: Path, base: Path | None, out: Path) -> None:
    """Join the head in FIT, a folder by `share train fit`, to the backbone; write the model, and beside it a
    model card with its results on the test rooms.

    \b
    Example:  share train export fit --labels labels --out error_model.onnx
    """
    _check_train_extra()
    from share.files.writing import atomic_write, check_writable
    from share.lab.train.compare import assemble, score_network
    from share.lab.train.network import origin
    from share.lab.train.score import model_card

    check_writable(out)
    assembled = assemble(fitted, labels, _base_model_file(base))
    score = score_network("this model", assembled.network, assembled.test)
    card_text = model_card(assembled.fitted.about, [score], len(assembled.model), origin(assembled.model))
    atomic_write(out, assembled.model)
    atomic_write(out.with_suffix(".md"), card_text)
    click.echo(card_text)
    click.echo(f"model: {out}   card: {out.with_suffix('.md')}")


@train.command(short_help="Compare the trained model with four others on the test rooms.")
@click.argument("labels", metavar="LABELS", type=options.PATH)
@click.option(
    "--fit", "fitted", required=True, metavar="FIT", type=options.PATH, help="Folder by share train fit."
)
@_BASE_OPTION
@options.as_json
def compare(labels: Path, fitted: Path, base: Path | None, as_json: bool) -> None:
    """Train linear regression, a random forest, an MLP and a contrastive CNN on the training rooms of the
    network in FIT, and score all of them on the test rooms.

    \b
    Example:  share train compare labels --fit fit
    """
    _check_train_extra()
    from share.lab.train.compare import assemble, score_baselines, score_network
    from share.lab.train.score import score_table, scores_json

    live = LiveLine()
    live.write("computing backbone features")
    assembled = assemble(fitted, labels, _base_model_file(base))
    seed, scores = assembled.fitted.about["options"]["seed"], []
    for score in score_baselines(assembled.collection, assembled.deep_features, seed, live.write):
        live.print_line(f"{score.name}: RMSE {score.rmse_cm:.2f} cm")
        scores.append(score)
    live.write("ours, keyframe by keyframe")
    scores.append(score_network("ours", assembled.network, assembled.test))
    live.end()
    if as_json:
        click.echo(scores_json(scores))
    else:
        click.echo(score_table(scores))


def _base_model_file(model_given: Path | None) -> Path:
    from share.odometry.error_model.network import SHIPPED_MODEL

    if model_given is None and not SHIPPED_MODEL.is_file():
        raise UsageError(
            "--base: no model is shipped yet; make a backbone with tools/experiments/make_backbone.py"
        )
    return model_given or SHIPPED_MODEL


def _check_train_extra() -> None:
    import importlib.util

    missing = [name for name in ("torch", "onnx", "sklearn") if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageError(install_hint(", ".join(missing), "train"))


def _summary(errors: list[F32]) -> str:
    import numpy as np

    error_cm = np.concatenate(errors)
    known = error_cm[np.isfinite(error_cm)]
    text = f"{len(errors)} runs, {len(error_cm)} keyframes, {len(known)} with a known error"
    if not len(known):
        return text
    percentiles = np.percentile(known, [5, 25, 50, 75, 95, 99])
    return f"{text}\nerror, cm: " + ", ".join(
        f"{percent} % below {cm:.2g}"
        for percent, cm in zip((5, 25, 50, 75, 95, 99), percentiles, strict=True)
    )
