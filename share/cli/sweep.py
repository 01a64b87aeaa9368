"""`share evaluate sweep`: which settings serve agents best."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.playing import check_all, of_many, played
from share.cli.terms import on_terms, settings
from share.config import POLICIES
from share.errors import UsageError

if TYPE_CHECKING:
    from share.lab.evaluate.sweep import Axis, Point
    from share.lab.evaluate.trial import Trial

_HEAT = ("AR latency", "AR ATE in the map", "merges a metre", "AR QoE")


@click.command(short_help="Settings tried one after the other, on sessions.")
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--set",
    "said",
    multiple=True,
    required=True,
    metavar="NAME=VALUES",
    help="SECTION.NAME=V,V… or, with --random, =LOW:HIGH; A.B+C.D=V,V… share a value. May be repeated.",
)
@click.option(
    "--random", "count", type=click.IntRange(1), help="So many points, drawn, in place of the grid."
)
@click.option("--policy", type=click.Choice(POLICIES), default=POLICIES[0], show_default=True)
@on_terms
@of_many
@click.option("--scheduler", metavar="tcp://H:P", help="Of a dask cluster whose workers play (--virtual).")
@options.config
@click.option("--out", required=True, metavar="DIR", type=click.Path(path_type=Path))
def sweep(
    sessions: tuple[Path, ...],
    said: tuple[str, ...],
    count: int | None,
    policy: str,
    seeds: int,
    workers: int,
    scheduler: str | None,
    config_file: str | None,
    out: Path,
    **told: Any,
) -> None:
    """Play SESSIONS at each point of a grid of settings, or at points that are drawn.

    In DIR: a folder a run, sweep.csv, sweep.md, and heat maps over the first two settings of a grid. Each
    run is kept as it comes; broken off, the same command goes on where it stopped.

    \b
    Example:  share evaluate sweep room1 --virtual --set control.kp=0.2,0.8 --set control.ki=0,0.1 --out s
    """
    if (workers > 1 or scheduler) and not told["virtual"]:
        which = "--scheduler" if scheduler else "--workers"
        raise UsageError(f"{which}: runs in real time would slow each other down; it goes with --virtual")
    from share.files.writing import writable_dir
    from share.lab.evaluate.campaign import side_by_side
    from share.lab.evaluate.cluster import Cluster
    from share.lab.evaluate.play import Terms
    from share.lab.evaluate.sweep import Axis, drawn, grid, planned
    from share.recordings.session import read_session

    axes = [Axis.parse(text) for text in said]
    points = grid(axes) if count is None else drawn(axes, count, seed=0)
    opened = [read_session(folder) for folder in sessions]
    config = settings(config_file, told, opened)
    runs = planned(opened, axes, points, range(seeds), Terms(policy, **told), out / "runs", config)
    writable_dir(out, "sweep.csv", "sweep.md")
    at = {one.out: point for one, point in runs}
    players = Cluster(scheduler) if scheduler else side_by_side(workers)
    trials = played([one for one, _ in runs], players, lambda one: ", ".join(at[one.out]))
    if trials:
        _write(out, axes, [at[folder] for folder in trials], list(trials.values()))
    check_all(len(trials), len(runs))


def _write(out: Path, axes: list[Axis], points: list[Point], trials: list[Trial]) -> None:
    from share.files.writing import atomic_write
    from share.lab.evaluate.charts import draw_heat
    from share.lab.evaluate.report import sweep_csv, sweep_markdown
    from share.lab.evaluate.scoring import figures
    from share.lab.evaluate.statistics import MEASURES
    from share.lab.evaluate.sweep import heat, table

    runs = [figures(trial) for trial in trials]
    rows = table(axes, list(zip(points, runs, strict=True)))
    report = sweep_markdown(rows, runs, trials)
    atomic_write(out / "sweep.csv", sweep_csv(rows))
    atomic_write(out / "sweep.md", report)
    click.echo(report)
    told = f"report: {out / 'sweep.md'}   table: {out / 'sweep.csv'}"
    if len(axes) > 1 and not any(axis.is_range for axis in axes):
        maps = {one.titled: heat(axes, rows, one.name) for one in MEASURES if one.name in _HEAT}
        draw_heat(out / "heat.png", maps, (axes[0].name, axes[0].values), (axes[1].name, axes[1].values))
        told += f"   picture: {out / 'heat.png'}"
    click.echo(told)
