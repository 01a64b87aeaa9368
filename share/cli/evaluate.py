"""`share evaluate`: play sessions, score them, compare policies."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.compare_trackers import compare
from share.cli.evaluate_sweep import sweep
from share.cli.many_runs import check_none_failed, many_run_options, play_runs
from share.cli.run_options import load_run_config, run_options
from share.cli.run_table import run_table
from share.cli.terminal import LiveLine
from share.config import POLICY_NAMES
from share.errors import UsageError

if TYPE_CHECKING:
    from share.lab.evaluate.report import ReportSection
    from share.lab.evaluate.trial import Trial

BASE_POLICY = "covins-g"  # the policy to which the others are compared


@click.group()
def evaluate() -> None:
    """Play sessions, score them, and compare policies, settings and trackers.

    \b
    Example:  share emulate --scene warehouse --motion paper:1 --seconds 60 --out room1
              share evaluate run room1 --link wifi5 --out runs/one
              share evaluate score runs/one
              share evaluate ablation room1 --link wifi5 --out ablation
    """


evaluate.add_command(sweep)
evaluate.add_command(compare)


@evaluate.command(short_help="Play a session and keep all outputs.")
@click.argument("session", type=click.Path(path_type=Path))
@click.option(
    "--policy",
    type=click.Choice(POLICY_NAMES),
    default=POLICY_NAMES[0],
    show_default=True,
    help="How keyframe rates are set.",
)
@run_options
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of link and scheduler."
)
@options.config
@click.option("--out", required=True, metavar="RUN", type=click.Path(path_type=Path), help="A new folder.")
def run(
    session: Path,
    policy: str,
    seed: int,
    config_file: str | None,
    out: Path,
    **options_given: Any,
) -> None:
    """Play SESSION in real time with an edge and its agents, each its own process; or, with --virtual, with
    the same trackers and state machines in virtual time, independent of this machine's load.

    RUN gets all outputs, the effective settings and whatever else a repetition needs. An interrupted run
    leaves nothing.

    \b
    Example:  share evaluate run room1 --policy covins-g --link wifi5 --out runs/covins
    """
    from share.lab.evaluate.real_time import RunOptions
    from share.lab.evaluate.scoring import run_metrics
    from share.lab.evaluate.trial import run_trial
    from share.recordings.session import read_session

    opened, live = read_session(session), LiveLine()
    config = load_run_config(config_file, options_given, [opened])
    run_terms = RunOptions(policy, seed=seed, **options_given)
    trial = run_trial(opened, run_terms, config, out, lambda now: live.write(str(now)))
    live.end()
    click.echo(run_table(run_metrics(trial)))


@evaluate.command(short_help="Score runs: errors, latency, merges, QoE.")
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--csv",
    "csv_file",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="CSV file with a line per agent.",
)
@click.option(
    "--plots",
    metavar="DIR",
    type=click.Path(path_type=Path),
    help="Folder for charts: QoE and rates over time, merges over distance.",
)
@options.as_json
def score(runs: tuple[Path, ...], csv_file: Path | None, plots: Path | None, as_json: bool) -> None:
    """Score RUNS, folders by `share evaluate run`, against the ground truth of their sessions.

    \b
    Example:  share evaluate score runs/* --plots plots
    """
    from share.files.json_file import nan_to_none
    from share.files.writing import atomic_write, check_writable, writable_dir
    from share.lab.evaluate.report import PROTOCOL, agents_csv
    from share.lab.evaluate.report_charts import draw_sessions
    from share.lab.evaluate.scoring import run_metrics
    from share.lab.evaluate.trial import read_trial

    if csv_file is not None:
        check_writable(csv_file)
    trials = [read_trial(folder) for folder in runs]
    all_metrics = [run_metrics(trial) for trial in trials]
    if csv_file is not None:
        atomic_write(csv_file, agents_csv(all_metrics))
    if as_json:
        documents = [
            nan_to_none(dataclasses.asdict(one) | {"metres": one.metres}) | {"record": trial.record}
            for one, trial in zip(all_metrics, trials, strict=True)
        ]
        click.echo(json.dumps({"protocol": PROTOCOL, "runs": documents}, default=str))
        return
    for one, trial in zip(all_metrics, trials, strict=True):
        machine, code = trial.record["machine"], one.conditions.code or "unknown"
        click.echo(run_table(one))
        click.echo(
            f"played {trial.record['began']} by SHARE {trial.record['version']} (code {code}) on "
            f"{machine['cores']} cores of {machine['cpu']}, load before {machine['load']:g}\n"
        )
    click.echo("\n".join(PROTOCOL))
    if plots is not None:
        pictures = draw_sessions(writable_dir(plots), trials)
        click.echo(f"\npictures: {', '.join(map(str, pictures))}")


@evaluate.command(short_help="Compare policies on sessions.")
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--policy",
    "policies_given",
    type=click.Choice(POLICY_NAMES),
    multiple=True,
    help="A policy to compare; may be repeated.  [default: all that share a map]",
)
@run_options
@many_run_options
@click.option(
    "--with",
    "section_paths",
    multiple=True,
    metavar="PATH",
    type=click.Path(path_type=Path, exists=True),
    help="Add to the report: a folder by `evaluate sweep`, or a file by `train compare --json`.",
)
@options.config
@options.out_folder
def ablation(
    sessions: tuple[Path, ...],
    policies_given: tuple[str, ...],
    section_paths: tuple[Path, ...],
    seeds: int,
    workers: int,
    config_file: str | None,
    out: Path,
    **options_given: Any,
) -> None:
    """Play SESSIONS with each policy and each seed, and compare the policies.

    The policies take turns on each session, so that a slower machine affects all alike. DIR gets a folder
    per run, report.html (opens offline), report.md, agents.csv, runs.csv and pictures. An interrupted command
    continues when it is run again.

    \b
    Example:  share evaluate ablation room1 room2 --policy share --policy covins-g --link wifi5 --out two
    """
    if workers > 1 and not options_given["virtual"]:
        raise UsageError("--workers needs --virtual: parallel runs in real time would slow each other down")
    from share.files.writing import writable_dir
    from share.lab.evaluate.campaign import plan_policies, worker_pool
    from share.lab.evaluate.real_time import RunOptions
    from share.lab.evaluate.report import read_section
    from share.recordings.session import read_session

    policies = policies_given or tuple(policy for policy in POLICY_NAMES if policy != "streamed")
    sections = [read_section(path, number) for number, path in enumerate(section_paths, 1)]
    opened = [read_session(folder) for folder in sessions]
    config = load_run_config(config_file, options_given, opened)
    planned_runs = plan_policies(
        opened, policies, range(seeds), RunOptions("", **options_given), out / "runs", config
    )
    writable_dir(out, "agents.csv", "runs.csv", "report.md", "report.html")
    trials_by_folder = play_runs(planned_runs, worker_pool(workers), lambda one: one.out.name)
    trials = list(trials_by_folder.values())
    failed = [one.out.name for one in planned_runs if one.out not in trials_by_folder]
    if trials:
        _write_report(out, trials, failed, sections)
    check_none_failed(len(trials), len(planned_runs))


def _write_report(out: Path, trials: list[Trial], failed: list[str], sections: list[ReportSection]) -> None:
    from share.files.writing import atomic_write
    from share.lab.evaluate.report import agents_csv, html_page, markdown, runs_csv
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
    atomic_write(out / "report.md", report)
    atomic_write(out / "report.html", html_page("Policies compared", report, out))
    click.echo(markdown(all_metrics, trials, base, failed))
    click.echo(f"report: {out / 'report.html'}, {out / 'report.md'}   tables: {out}/*.csv")
