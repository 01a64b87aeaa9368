"""`share evaluate ablation` and `sweep`: many runs, in sequence or in parallel."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.terminal import LiveLine
from share.config import BASE_POLICY, POLICY_NAMES, STREAMED
from share.errors import ShareError, UsageError

if TYPE_CHECKING:
    from share.lab.evaluate.campaign import PlannedRun, WorkerPool
    from share.lab.evaluate.real_time import Progress
    from share.lab.evaluate.report import ReportSection
    from share.lab.evaluate.sweep import Point, SweepAxis
    from share.lab.evaluate.trial import Trial

many_run_options = options.option_group(
    click.option("--seeds", type=click.IntRange(1), default=1, help="Number of seeds (0, 1, …), each a run."),
    click.option(
        "--workers",
        type=click.IntRange(1, 64),
        default=1,
        help="Runs in parallel; more than 1 needs --virtual.",
    ),
)


def play_runs(
    runs: Sequence[PlannedRun],
    workers: AbstractContextManager[WorkerPool] | None,
    label_of: Callable[[PlannedRun], str],
) -> dict[Path, Trial]:
    """Play runs; return those that succeeded, by folder, in the order of `runs`. Print why others failed."""
    from share.lab.evaluate.campaign import run_all

    live, done = LiveLine(), dict[Path, "Trial"]()

    def show(number: int, now: Progress | None) -> None:
        live.write(f"{number + 1} of {len(runs)}: {label_of(runs[number])}  {now or ''}")

    for one, result in run_all(runs, show, workers):
        if isinstance(result, ShareError):
            live.print_line(f"share: {one.out.name}: {result}")
        else:
            done[one.out] = result
    live.end()
    return {one.out: done[one.out] for one in runs if one.out in done}


def _check_parallel(option: str | None, virtual: bool) -> None:
    """Raise UsageError if an option asks for parallel runs (None: none does) in real time."""
    if option is not None and not virtual:
        raise UsageError(f"{option} needs --virtual: parallel runs in real time would slow each other down")


def check_none_failed(succeeded: int, total: int) -> None:
    """Raise ShareError if any run failed."""
    if succeeded < total:
        raise ShareError(
            f"{total - succeeded} of {total} runs failed; run the same command again to repeat only those"
        )


@click.command()
@click.argument("sessions", nargs=-1, required=True, type=options.PATH)
@click.option(
    "--policy",
    "policies_given",
    type=click.Choice(POLICY_NAMES),
    multiple=True,
    help="A policy to compare. May be repeated.  [default: all that share a map]",
)
@options.run_options
@many_run_options
@options.explain_policies
@click.option(
    "--with",
    "section_paths",
    multiple=True,
    metavar="PATH",
    type=click.Path(path_type=Path, exists=True),
    help="Add to the report: a folder by `evaluate sweep`, or a file by `train compare --json`. May be "
    "repeated.",
)
@options.config
@options.out_folder
@options.as_json
def ablation(
    sessions: tuple[Path, ...],
    policies_given: tuple[str, ...],
    section_paths: tuple[Path, ...],
    seeds: int,
    workers: int,
    config_file: Path | None,
    out: Path,
    as_json: bool,
    **options_given: Any,
) -> None:
    """Play SESSIONS with each policy and each seed, and compare the policies.

    The policies take turns on each session, so that a slower machine affects all alike. DIR gets a folder
    per run, report.html (opens offline), report.md, agents.csv, runs.csv, table.tex and pictures. An
    interrupted command continues when it is run again.

    \b
    Example:  share evaluate ablation room1 room2 --policy share --policy covins-g --link wifi5 --out two
    """
    _check_parallel("--workers" if workers > 1 else None, options_given["virtual"])
    from share.files.writing import writable_dir
    from share.lab.evaluate.campaign import plan_policies, worker_pool
    from share.lab.evaluate.real_time import RunOptions
    from share.lab.evaluate.report import read_section
    from share.recordings.session import read_session

    policies = policies_given or tuple(name for name in POLICY_NAMES if name != STREAMED)
    sections = [read_section(path, number) for number, path in enumerate(section_paths, 1)]
    opened = [read_session(folder) for folder in sessions]
    config = options.load_run_config(config_file, policies, options_given, opened)
    planned_runs = plan_policies(
        opened, policies, range(seeds), RunOptions("", **options_given), out / "runs", config
    )
    writable_dir(out, "agents.csv", "runs.csv", "table.tex", "report.md", "report.html")
    trials_by_folder = play_runs(planned_runs, worker_pool(workers), lambda one: one.out.name)
    trials = list(trials_by_folder.values())
    failed = [one.out.name for one in planned_runs if one.out not in trials_by_folder]
    if trials:
        _write_ablation_report(out, trials, failed, sections, as_json)
    check_none_failed(len(trials), len(planned_runs))


def _write_ablation_report(
    out: Path, trials: list[Trial], failed: list[str], sections: list[ReportSection], as_json: bool
) -> None:
    from share.files.writing import atomic_write
    from share.lab.evaluate.policy_report import comparison_document, latex_table, markdown
    from share.lab.evaluate.report import agents_csv, html_page, runs_csv
    from share.lab.evaluate.report_charts import draw_report
    from share.lab.evaluate.scoring import run_metrics
    from share.lab.evaluate.statistics import policy_names
    from share.recordings.images import read_picture

    all_metrics = [run_metrics(trial) for trial in trials]
    names = policy_names(all_metrics)
    base = BASE_POLICY if BASE_POLICY in names else names[0]
    report_pictures = draw_report(out, all_metrics, trials, base)
    report = "\n".join(
        [markdown(all_metrics, trials, base, failed, report_pictures), *(one.text for one in sections)]
    )
    for name, path in (named for one in sections for named in one.pictures.items()):
        atomic_write(out / name, read_picture(path))
    atomic_write(out / "agents.csv", agents_csv(all_metrics))
    atomic_write(out / "runs.csv", runs_csv(all_metrics))
    atomic_write(out / "table.tex", latex_table(all_metrics, base))
    atomic_write(out / "report.md", report)
    atomic_write(out / "report.html", html_page("Policies compared", report, out))
    if as_json:
        click.echo(json.dumps({"failed": failed, **comparison_document(all_metrics, base)}))
        return
    click.echo(markdown(all_metrics, trials, base, failed))
    click.echo(f"report: {out / 'report.html'}, {out / 'report.md'}   tables: {out}/*.csv, *.tex")


_HEAT_MAP_MEASURES = ("AR latency", "AR ATE in the map", "merges per metre", "AR QoE")


@click.command()
@click.argument("sessions", nargs=-1, required=True, type=options.PATH)
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
@options.policy
@options.run_options
@many_run_options
@click.option("--scheduler", metavar="tcp://H:P", help="Dask cluster that plays the runs (needs --virtual).")
@options.config
@options.out_folder
@options.as_json
def sweep(
    sessions: tuple[Path, ...],
    axis_texts: tuple[str, ...],
    count: int | None,
    policy: str | None,
    seeds: int,
    workers: int,
    scheduler: str | None,
    config_file: Path | None,
    out: Path,
    as_json: bool,
    **options_given: Any,
) -> None:
    """Play SESSIONS at each point of a grid of settings, or at random points.

    DIR gets a folder per run, sweep.csv, sweep.md, and heat maps over the first two settings of a grid. An
    interrupted command continues when it is run again.

    \b
    Example:  share evaluate sweep room1 --virtual --set control.kp=0.2,0.8 --set control.ki=0,0.1 --out s
    """
    parallel_option = "--scheduler" if scheduler else "--workers" if workers > 1 else None
    _check_parallel(parallel_option, options_given["virtual"])
    from share.files.writing import writable_dir
    from share.lab.evaluate.campaign import Cluster, worker_pool
    from share.lab.evaluate.real_time import RunOptions
    from share.lab.evaluate.sweep import SweepAxis, grid, plan_sweep, random_points
    from share.recordings.session import read_session

    axes = [SweepAxis.parse(text) for text in axis_texts]
    points = grid(axes) if count is None else random_points(axes, count, seed=0)
    opened = [read_session(folder) for folder in sessions]
    config = options.load_run_config(config_file, [policy], options_given, opened)
    runs = plan_sweep(
        opened,
        axes,
        points,
        range(seeds),
        RunOptions(config.edge.policy, **options_given),
        out / "runs",
        config,
    )
    writable_dir(out, "sweep.csv", "sweep.md")
    point_of = {one.out: point for one, point in runs}
    pool = Cluster(scheduler) if scheduler else worker_pool(workers)
    trials = play_runs([one for one, _ in runs], pool, lambda one: ", ".join(point_of[one.out]))
    if trials:
        points_played = [point_of[folder] for folder in trials]
        _write_sweep_report(out, axes, points_played, list(trials.values()), as_json)
    check_none_failed(len(trials), len(runs))


def _write_sweep_report(
    out: Path, axes: list[SweepAxis], points: list[Point], trials: list[Trial], as_json: bool
) -> None:
    from share.files.json_file import nan_to_none
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
    message = f"report: {out / 'sweep.md'}   table: {out / 'sweep.csv'}"
    if len(axes) > 1 and not any(axis.is_range for axis in axes):
        heat_maps = {
            one.title: heat_map(axes, rows, one.name) for one in MEASURES if one.name in _HEAT_MAP_MEASURES
        }
        draw_heat_maps(
            out / "heat.png", heat_maps, (axes[0].name, axes[0].values), (axes[1].name, axes[1].values)
        )
        message += f"   picture: {out / 'heat.png'}"
    if as_json:
        plain = [
            {**row, "means": {name: mean._asdict() for name, mean in row["means"].items()}} for row in rows
        ]
        click.echo(json.dumps({"points": nan_to_none(plain)}))
        return
    click.echo(f"{report}\n{message}")
