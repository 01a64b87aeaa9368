"""`share evaluate`: sessions played on stated terms, scored, and policies compared."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.compare import compare
from share.cli.playing import check_all, of_many, played
from share.cli.progress import LiveLine
from share.cli.run_table import table
from share.cli.sweep import sweep
from share.cli.terms import on_terms, settings
from share.config import POLICIES
from share.errors import UsageError

if TYPE_CHECKING:
    from share.lab.evaluate.report import Annex
    from share.lab.evaluate.trial import Trial

BASE = "covins-g"  # what the others are told as a part of


@click.group()
def evaluate() -> None:
    """Play sessions on stated terms, score them, and compare policies.

    \b
    Example:  share emulate --scene warehouse --motion paper:1 --seconds 60 --out room1
              share evaluate run room1 --link wifi5 --out runs/one
              share evaluate score runs/one
              share evaluate ablation room1 --link wifi5 --out ablation
    """


evaluate.add_command(sweep)
evaluate.add_command(compare)


@evaluate.command(short_help="Play a session, and keep everything.")
@click.argument("session", type=click.Path(path_type=Path))
@click.option("--policy", type=click.Choice(POLICIES), default=POLICIES[0], show_default=True)
@on_terms
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of link and scheduler.")
@options.config
@click.option("--out", required=True, metavar="RUN", type=click.Path(path_type=Path), help="A new folder.")
def run(
    session: Path,
    policy: str,
    seed: int,
    config_file: str | None,
    out: Path,
    **told: Any,
) -> None:
    """Play SESSION in real time: an edge and its agents, each a process of its own. Or, with --virtual, by
    the same trackers and machines in virtual time, whatever else this machine does.

    RUN holds what they leave, the settings in effect and what else is needed to play it again. It is
    whole or not there: a run that is broken off leaves nothing.

    \b
    Example:  share evaluate run room1 --policy covins-g --link wifi5 --out runs/covins
    """
    from share.lab.evaluate.play import Terms
    from share.lab.evaluate.scoring import figures
    from share.lab.evaluate.trial import run_trial
    from share.recordings.session import read_session

    opened, live = read_session(session), LiveLine()
    config, terms = settings(config_file, told, [opened]), Terms(policy, seed=seed, **told)
    trial = run_trial(opened, terms, config, out, lambda now: live.write(str(now)))
    live.end()
    click.echo(table(figures(trial)))


@evaluate.command(short_help="Errors, latency, merges and QoE of runs.")
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--csv", "csv_file", metavar="FILE", type=click.Path(path_type=Path), help="A line an agent.")
@click.option(
    "--plots",
    metavar="DIR",
    type=click.Path(path_type=Path),
    help="QoE and rates over time, merges on the way.",
)
@options.as_json
def score(runs: tuple[Path, ...], csv_file: Path | None, plots: Path | None, as_json: bool) -> None:
    """Score RUNS, folders by `share evaluate run`, against the truth of their sessions.

    \b
    Example:  share evaluate score runs/* --plots plots
    """
    from share.files.json_file import known
    from share.files.writing import atomic_write, check_writable, writable_dir
    from share.lab.evaluate.pictures import draw_each
    from share.lab.evaluate.report import PROTOCOL, agents_csv
    from share.lab.evaluate.scoring import figures
    from share.lab.evaluate.trial import read_trial

    if csv_file is not None:
        check_writable(csv_file)
    trials = [read_trial(folder) for folder in runs]
    found = [figures(trial) for trial in trials]
    if csv_file is not None:
        atomic_write(csv_file, agents_csv(found))
    if as_json:
        told = [
            known(dataclasses.asdict(one) | {"metres": one.metres}) | {"record": trial.record}
            for one, trial in zip(found, trials, strict=True)
        ]
        click.echo(json.dumps({"protocol": PROTOCOL, "runs": told}, default=str))
        return
    for one, trial in zip(found, trials, strict=True):
        machine, code = trial.record["machine"], one.conditions.code or "unknown"
        click.echo(table(one))
        click.echo(
            f"played {trial.record['began']} by SHARE {trial.record['version']} (code {code}) on "
            f"{machine['cores']} cores of {machine['cpu']}, load before {machine['load']:g}\n"
        )
    click.echo("\n".join(PROTOCOL))
    if plots is not None:
        drawn = draw_each(writable_dir(plots), trials)
        click.echo(f"\npictures: {', '.join(map(str, drawn))}")


@evaluate.command(short_help="All policies on sessions, in turn, compared.")
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--policy",
    "chosen",
    type=click.Choice(POLICIES),
    multiple=True,
    help="May be repeated.  [default: all that share a map]",
)
@on_terms
@of_many
@click.option(
    "--with",
    "annexes",
    multiple=True,
    metavar="PATH",
    type=click.Path(path_type=Path, exists=True),
    help="What else the report is to show: a folder by `evaluate sweep`, a file by `train compare --json`.",
)
@options.config
@click.option("--out", required=True, metavar="DIR", type=click.Path(path_type=Path))
def ablation(
    sessions: tuple[Path, ...],
    chosen: tuple[str, ...],
    annexes: tuple[Path, ...],
    seeds: int,
    workers: int,
    config_file: str | None,
    out: Path,
    **told: Any,
) -> None:
    """Play SESSIONS by each policy with each seed, and compare the policies.

    Policies follow each other on each session, so that a machine that slows down does so for all. In DIR:
    a folder a run, report.html (opens offline), report.md, agents.csv, runs.csv and pictures. Broken off,
    the same command goes on where it stopped.

    \b
    Example:  share evaluate ablation room1 room2 --policy share --policy covins-g --link wifi5 --out two
    """
    if workers > 1 and not told["virtual"]:
        raise UsageError("--workers: runs in real time would slow each other down; it goes with --virtual")
    from share.files.writing import writable_dir
    from share.lab.evaluate.campaign import plan, side_by_side
    from share.lab.evaluate.play import Terms
    from share.lab.evaluate.report import annex
    from share.recordings.session import read_session

    policies = chosen or tuple(policy for policy in POLICIES if policy != "streamed")
    also = [annex(path, number) for number, path in enumerate(annexes, 1)]
    opened = [read_session(folder) for folder in sessions]
    config = settings(config_file, told, opened)
    planned = plan(opened, policies, range(seeds), Terms("", **told), out / "runs", config)
    writable_dir(out, "agents.csv", "runs.csv", "report.md", "report.html")
    came = played(planned, side_by_side(workers), lambda one: one.out.name)
    trials, failed = list(came.values()), [one.out.name for one in planned if one.out not in came]
    if trials:
        _write(out, trials, failed, also)
    check_all(len(trials), len(planned))


def _write(out: Path, trials: list[Trial], failed: list[str], also: list[Annex]) -> None:
    from share.files.writing import atomic_write
    from share.lab.evaluate.page import page
    from share.lab.evaluate.pictures import draw
    from share.lab.evaluate.report import agents_csv, markdown, runs_csv
    from share.lab.evaluate.scoring import figures
    from share.lab.evaluate.statistics import policies
    from share.recordings.images import read_picture

    found = [figures(trial) for trial in trials]
    names = policies(found)
    base = BASE if BASE in names else names[0]
    shown = draw(out, found, trials, base)
    report = "\n".join([markdown(found, trials, base, failed, shown), *(one.text for one in also)])
    for name, path in (named for one in also for named in one.pictures.items()):
        atomic_write(out / name, read_picture(path))
    atomic_write(out / "agents.csv", agents_csv(found))
    atomic_write(out / "runs.csv", runs_csv(found))
    atomic_write(out / "report.md", report)
    atomic_write(out / "report.html", page("Policies compared", report, out))
    click.echo(markdown(found, trials, base, failed))
    click.echo(f"report: {out / 'report.html'}, {out / 'report.md'}   tables: {out}/*.csv")
