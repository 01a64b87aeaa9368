"""Figures of trials as text: CSV for a program, Markdown for a reader."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from share.metrics.bootstrap import Interval
from share.metrics.comparison import MEASURES, compare, no_worse, no_worse_on_average, policies
from share.metrics.figures import AgentFigures, Conditions, RunFigures
from share.run.as_text import bullets, csv_text, markdown_table, number
from share.run.trial import Trial

_AGENT = [field.name for field in dataclasses.fields(AgentFigures)]
_CONDITIONS = [field.name for field in dataclasses.fields(Conditions)]
_RUN = ("in_one_map", "joint_ate_cm", "merges_requested", "merges_skipped", "merges_done", "merges_per_metre")
PROTOCOL = (
    "latency: mean over all frames' track_ms and all corrected_ms together; ms from a frame's arrival",
    "poses: causal, every frame that has one; truth interpolated at their stamps over at most 100 ms",
    "odom ATE: rms, SE3-aligned, each agent alone; map ATE: rms under one SE3 alignment for all in one map",
    "RPE: rms of poses in the map, from frame to frame and over 1 s, no alignment; docs/evaluation.md",
)


def agents_csv(runs: Iterable[RunFigures]) -> str:
    """A line an agent and run."""
    return csv_text(
        [*_CONDITIONS, *_AGENT],
        ([*_conditions(run), *(getattr(agent, f) for f in _AGENT)] for run in runs for agent in run.agents),
    )


def runs_csv(runs: Iterable[RunFigures]) -> str:
    """A line a run."""
    return csv_text(
        [*_CONDITIONS, *_RUN, "metres"],
        ([*_conditions(run), *(getattr(run, f) for f in _RUN), run.metres] for run in runs),
    )


def sweep_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """A line a point; rows: by `share.run.sweep.table`."""
    head = [*rows[0]["settings"], "runs", *rows[0]["means"]]
    return csv_text(
        head,
        ([*row["settings"].values(), row["runs"], *(m.value for m in row["means"].values())] for row in rows),
    )


def sweep_markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """The same for a reader, with intervals."""
    head = [*rows[0]["settings"], "runs", *rows[0]["means"]]
    body = [
        [*row["settings"].values(), str(row["runs"]), *(_wide(m) for m in row["means"].values())]
        for row in rows
    ]
    return markdown_table([head, *body]) + "\n\nIn brackets: 95 % by drawing the runs again.\n"


def markdown(runs: Sequence[RunFigures], trials: Sequence[Trial], base: str) -> str:
    """All policies against `base`."""
    names = policies(runs)
    parts = [
        "# Policies compared",
        _provenance(runs, trials),
        f"## Each policy, and as a part of `{base}`",
        _comparison(runs, names, base),
        "In brackets: 95 % by drawing the runs again (pairs of the same session, link and seed).",
    ]
    others = [name for name in names if name != names[0]]
    if others:
        parts += [f"## Errors by `{names[0]}`", *(_wins(runs, names[0], other) for other in others)]
    parts += ["## Every agent", _every_agent(runs, names)]
    return "\n\n".join(parts) + "\n"


def _provenance(runs: Sequence[RunFigures], trials: Sequence[Trial]) -> str:
    records = [trial.record for trial in trials]
    machines = {
        f"{r['machine']['cpu']}, {r['machine']['cores']} cores, {r['machine']['system']}" for r in records
    }
    loads = [r["machine"]["load"] for r in records]
    told = [
        f"{len(runs)} runs {_how(trials[0])}, "
        f"{min(r['began'] for r in records)} to {max(r['began'] for r in records)}.",
        f"Sessions: {', '.join(sorted({run.conditions.session for run in runs}))}; "
        f"links: {', '.join(sorted({run.conditions.link or 'loopback' for run in runs}))}; "
        f"seeds: {', '.join(map(str, sorted({run.conditions.seed for run in runs})))}.",
        f"Machine: {'; '.join(sorted(machines))}; load before a run {min(loads):g} to {max(loads):g}.",
        f"SHARE {', '.join(sorted({r['version'] for r in records}))}; evaluations tell {_told(records[0])}.",
    ]
    return "\n".join([*(f"* {line}" for line in told), bullets(PROTOCOL)])


def _told(record: Mapping[str, Any]) -> str:
    """Of a run: what the edge takes for an agent's error."""
    if record["true_error"]:
        return "the true error"
    model = record.get("error_model")
    return f"what the error model says ({Path(model).name})" if model else "odometry's sigma"


def _how(trial: Trial) -> str:
    terms = trial.terms
    if terms.virtual:
        return "in virtual time" + (f", things as long as in {Path(terms.costs).name}" if terms.costs else "")
    return "in real time, every agent and the edge a process" + (
        ", agents first" if terms.agents_first else ""
    )


def _comparison(runs: Sequence[RunFigures], names: Sequence[str], base: str) -> str:
    found = {name: compare(runs, name, base) for name in names}
    rows = [["", *names]]
    for k, measure in enumerate(MEASURES):
        cells = []
        for name in names:
            one = found[name][k]
            ratio = "" if name == base else f"; {_interval(one.ratio)}"
            cells.append(number(one.value.value) + ratio)
        rows.append([f"{measure.name}{', ' + measure.unit if measure.unit else ''}", *cells])
    return markdown_table(rows)


def _wins(runs: Sequence[RunFigures], name: str, other: str) -> str:
    better, of = no_worse(runs, name, other)
    means, of_means = no_worse_on_average(runs, name, other)
    told = f"in {better} of {of} runs of an agent (those in which it is in the map by both)"
    return f"* no more than by `{other}` {told}, in {means} of {of_means} means of an agent on a session"


def _every_agent(runs: Sequence[RunFigures], names: Sequence[str]) -> str:
    rows = [["session", "agent", *(f"{name}: ms, cm" for name in names)]]
    for session in dict.fromkeys(run.conditions.session for run in runs):
        for agent in dict.fromkeys(
            a.agent for r in runs if r.conditions.session == session for a in r.agents
        ):
            cells = [
                f"{number(mean_of(runs, name, session, agent, 'latency_ms'))}, "
                f"{number(mean_of(runs, name, session, agent, 'ate_cm'))}"
                for name in names
            ]
            rows.append([session, agent, *cells])
    return markdown_table(rows)


def mean_of(runs: Sequence[RunFigures], policy: str, session: str, agent: str, field: str) -> float:
    values = [
        getattr(one, field)
        for run in runs
        if run.conditions.policy == policy and run.conditions.session == session
        for one in run.agents
        if one.agent == agent
    ]
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan


def _conditions(run: RunFigures) -> list[object]:
    return [getattr(run.conditions, name) for name in _CONDITIONS]


def _interval(of: Interval) -> str:
    return "–" if math.isnan(of.value) else f"{of.value:.2f} [{of.low:.2f}, {of.high:.2f}]"


def _wide(of: Interval) -> str:
    return "–" if math.isnan(of.value) else f"{of.value:.3g} [{of.low:.3g}, {of.high:.3g}]"
