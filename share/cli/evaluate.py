"""`share evaluate`: play sessions, score them, compare policies."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.commands import CommandGroup
from share.cli.live_pages import RunScreen
from share.cli.terminal import Column, column_table
from share.errors import UsageError

if TYPE_CHECKING:
    from share.lab.evaluate.run_metrics import AgentMetrics, RunMetrics
    from share.lab.evaluate.trial import Trial


@click.group(cls=CommandGroup, prefix="evaluate ")
def evaluate() -> None:
    """Play sessions, score them, and compare policies, settings and trackers.

    \b
    Example:  share emulate --scene warehouse --motion paper:1 --seconds 60 --out room1
              share evaluate run room1 --link wifi5 --out runs/one
              share evaluate score runs/one
              share evaluate ablation room1 --link wifi5 --out ablation
    """


@evaluate.command(short_help="Play a session and keep all outputs.")
@click.argument("session", type=options.PATH)
@options.policy
@options.run_options
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of link and scheduler.")
@click.option("--view", is_flag=True, help="Show the room live in a browser; not with --virtual.")
@options.config
@click.option("--out", required=True, metavar="RUN", type=options.PATH, help="A new folder.")
@options.as_json
def run(
    session: Path,
    policy: str | None,
    seed: int,
    view: bool,
    config_file: Path | None,
    out: Path,
    as_json: bool,
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
    from share.lab.evaluate.report import PROTOCOL
    from share.lab.evaluate.scoring import run_metrics
    from share.lab.evaluate.trial import run_trial
    from share.recordings.session import read_session

    if view and options_given["virtual"]:
        raise UsageError("--view shows a run in real time; leave it or --virtual out")
    opened = read_session(session)
    config = options.load_run_config(config_file, [policy], options_given, [opened])
    run_terms = RunOptions(config.edge.policy, seed=seed, **options_given)
    screen = RunScreen(view, may_draw=view)
    trial = run_trial(opened, run_terms, config, out, screen.show, screen.pages)
    screen.end()
    metrics = run_metrics(trial)
    document = {"protocol": PROTOCOL, "runs": [_run_document(metrics, trial)]}
    click.echo(json.dumps(document, default=str) if as_json else run_table(metrics))


def _run_document(metrics: RunMetrics, trial: Trial) -> dict[str, Any]:
    """Return a run's metrics and record as plain data."""
    from share.files.json_file import nan_to_none

    values = dataclasses.asdict(metrics) | {"metres": metrics.metres}
    return {**nan_to_none(values), "record": trial.record}


@evaluate.command(short_help="Score runs: errors, latency, merges, QoE.")
@click.argument("runs", nargs=-1, required=True, type=options.PATH)
@click.option("--csv", "csv_file", metavar="FILE", type=options.PATH, help="CSV file with a line per agent.")
@click.option(
    "--plots",
    metavar="DIR",
    type=options.PATH,
    help="Folder for charts: QoE and rates over time, merges over distance.",
)
@options.as_json
def score(runs: tuple[Path, ...], csv_file: Path | None, plots: Path | None, as_json: bool) -> None:
    """Score RUNS, folders by `share evaluate run`, against the ground truth of their sessions.

    \b
    Example:  share evaluate score runs/* --plots plots
    """
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
        documents = [_run_document(one, trial) for one, trial in zip(all_metrics, trials, strict=True)]
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


def _value_text(value: float, unit: str, digits: int = 1) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f} {unit}".rstrip()


def _value(
    title: str, of: Callable[[AgentMetrics], float], unit: str, digits: int = 1, factor: float = 1.0
) -> Column:
    """Return a column with a figure of each agent, in a unit; "–" for NaN."""
    return title, lambda agent: _value_text(factor * of(agent), unit, digits)


def _plain(title: str, of: Callable[[AgentMetrics], object]) -> Column:
    return title, lambda agent: str(of(agent))


_LATENCY_COLUMNS = (
    _plain("", lambda a: a.agent),
    _value("latency", lambda a: a.latency_ms, "ms"),
    _value("frames", lambda a: a.track_ms, "ms"),
    _value("50 %", lambda a: a.track_p50_ms, "ms"),
    _value("95 %", lambda a: a.track_p95_ms, "ms"),
    _value("99 %", lambda a: a.track_p99_ms, "ms"),
    _value("> 20 ms", lambda a: a.over_20ms, "%", factor=100),
    _value("corrected", lambda a: a.corrected_ms, "ms"),
    _value("50 %", lambda a: a.corrected_p50_ms, "ms"),
    _value("95 %", lambda a: a.corrected_p95_ms, "ms"),
    _value("99 %", lambda a: a.corrected_p99_ms, "ms"),
    _plain("of", lambda a: a.corrected),
)
_ERROR_COLUMNS = (
    _plain("", lambda a: a.agent),
    _value("odom ATE", lambda a: a.odom_ate_cm, "cm", 2),
    _plain("of", lambda a: a.odom_n),
    _value("map ATE", lambda a: a.ate_cm, "cm", 2),
    _plain("of", lambda a: a.ate_n),
    _value("RPE frame", lambda a: a.rpe_frame_cm, "mm", factor=10),
    _value("", lambda a: a.rpe_frame_deg, "°", 3),
    _value("RPE 1 s", lambda a: a.rpe_1s_cm, "cm", 2),
    _value("", lambda a: a.rpe_1s_deg, "°", 2),
    _plain("of", lambda a: a.rpe_1s_n),
    _value("in a map", lambda a: a.shared_map_s, "s"),
    _value("sent", lambda a: a.rate_hz, "Hz"),
    _value("up", lambda a: a.kb_up_s, "kB/s", 0),
    _value("down", lambda a: a.kb_down_s, "kB/s", 0),
    _value("QoE", lambda a: a.qoe, "", 2),
    _value("reported error", lambda a: a.estimated_error_cm, "cm", 2),
)


def run_table(run: RunMetrics) -> str:
    """Return two tables with a line per agent, latency and then errors and sharing, and the merges."""
    merges = (
        f"merges: {run.merges_requested} requested, {run.merges_skipped} skipped, {run.merges_done} done, "
        f"{_value_text(run.merges_per_metre, 'a metre', 2)} over {run.metres:.0f} m"
    )
    c = run.conditions
    where = f"{c.session}: policy {c.policy}, {c.link or 'loopback'}, seed {c.seed}"
    joint_text = f"joint ATE {_value_text(run.joint_ate_cm, 'cm', 2)}"
    return (
        f"{where}; in {c.clock}, evaluations report {c.error_source}\n"
        f"{column_table(_LATENCY_COLUMNS, run.agents)}\n\n{column_table(_ERROR_COLUMNS, run.agents)}\n"
        f"{run.agents_in_largest_map} of {len(run.agents)} agents in one map, {joint_text}; {merges}"
    )
