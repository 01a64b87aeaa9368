"""`share evaluate sweep`: play sessions with many settings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.many_runs import check_none_failed, many_run_options, play_runs
from share.cli.run_options import load_run_config, run_options
from share.config import POLICY_NAMES
from share.errors import UsageError

if TYPE_CHECKING:
    from share.lab.evaluate.sweep import Axis, Point
    from share.lab.evaluate.trial import Trial

_HEAT_MAP_MEASURES = ("AR latency", "AR ATE in the map", "merges per metre", "AR QoE")


@click.command(short_help="Compare settings on sessions.")
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--set",
    "axis_texts",
    multiple=True,
    required=True,
    metavar="NAME=VALUES",
    help="SECTION.NAME=V,V,… or, with --random, =LOW:HIGH. A.B+C.D=V,… gives two settings the same value. "
    "May be repeated.",
)
@click.option(
    "--random", "count", type=click.IntRange(1), help="Draw this many random points instead of a grid."
)
@click.option(
    "--policy",
    type=click.Choice(POLICY_NAMES),
    default=POLICY_NAMES[0],
    show_default=True,
    help="How keyframe rates are set.",
)
@run_options
@many_run_options
@click.option("--scheduler", metavar="tcp://H:P", help="Dask cluster that plays the runs (needs --virtual).")
@options.config
@options.out_folder
def sweep(
    sessions: tuple[Path, ...],
    axis_texts: tuple[str, ...],
    count: int | None,
    policy: str,
    seeds: int,
    workers: int,
    scheduler: str | None,
    config_file: str | None,
    out: Path,
    **options_given: Any,
) -> None:
    """Play SESSIONS at each point of a grid of settings, or at random points.

    DIR gets a folder per run, sweep.csv, sweep.md, and heat maps over the first two settings of a grid. An
    interrupted command continues when it is run again.

    \b
    Example:  share evaluate sweep room1 --virtual --set control.kp=0.2,0.8 --set control.ki=0,0.1 --out s
    """
    if (workers > 1 or scheduler) and not options_given["virtual"]:
        which = "--scheduler" if scheduler else "--workers"
        raise UsageError(f"{which} needs --virtual: parallel runs in real time would slow each other down")
    from share.files.writing import writable_dir
    from share.lab.evaluate.campaign import Cluster, worker_pool
    from share.lab.evaluate.real_time import RunOptions
    from share.lab.evaluate.sweep import Axis, grid, plan_sweep, random_points
    from share.recordings.session import read_session

    axes = [Axis.parse(text) for text in axis_texts]
    points = grid(axes) if count is None else random_points(axes, count, seed=0)
    opened = [read_session(folder) for folder in sessions]
    config = load_run_config(config_file, options_given, opened)
    runs = plan_sweep(
        opened, axes, points, range(seeds), RunOptions(policy, **options_given), out / "runs", config
    )
    writable_dir(out, "sweep.csv", "sweep.md")
    point_of = {one.out: point for one, point in runs}
    pool = Cluster(scheduler) if scheduler else worker_pool(workers)
    trials = play_runs([one for one, _ in runs], pool, lambda one: ", ".join(point_of[one.out]))
    if trials:
        _write_report(out, axes, [point_of[folder] for folder in trials], list(trials.values()))
    check_none_failed(len(trials), len(runs))


def _write_report(out: Path, axes: list[Axis], points: list[Point], trials: list[Trial]) -> None:
    from share.files.writing import atomic_write
    from share.lab.evaluate.charts import draw_heat_maps
    from share.lab.evaluate.report import sweep_csv, sweep_markdown
    from share.lab.evaluate.scoring import run_metrics
    from share.lab.evaluate.statistics import MEASURES
    from share.lab.evaluate.sweep import heat_map, sweep_table

    runs = [run_metrics(trial) for trial in trials]
    rows = sweep_table(axes, list(zip(points, runs, strict=True)))
    report = sweep_markdown(rows, runs, trials)
    atomic_write(out / "sweep.csv", sweep_csv(rows))
    atomic_write(out / "sweep.md", report)
    click.echo(report)
    message = f"report: {out / 'sweep.md'}   table: {out / 'sweep.csv'}"
    if len(axes) > 1 and not any(axis.is_range for axis in axes):
        heat_maps = {
            one.title: heat_map(axes, rows, one.name) for one in MEASURES if one.name in _HEAT_MAP_MEASURES
        }
        draw_heat_maps(
            out / "heat.png", heat_maps, (axes[0].name, axes[0].values), (axes[1].name, axes[1].values)
        )
        message += f"   picture: {out / 'heat.png'}"
    click.echo(message)
