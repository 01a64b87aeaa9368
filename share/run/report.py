"""Figures of trials as text: CSV for a program, Markdown for a reader."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from share.metrics.bootstrap import Interval
from share.metrics.comparison import MEASURES, Compared, compare, no_worse, no_worse_on_average, policies
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
_DRAWN = (
    "In brackets: 95 % by drawing sessions again, each with all its runs; none where there is one session."
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


def sweep_markdown(
    rows: Sequence[Mapping[str, Any]], runs: Sequence[RunFigures], trials: Sequence[Trial]
) -> str:
    """The same for a reader, with intervals, and of what."""
    titles = {measure.name: measure.titled for measure in MEASURES}
    head = [*rows[0]["settings"], "runs", *(titles[name] for name in rows[0]["means"])]
    body = [
        [*row["settings"].values(), str(row["runs"]), *(_wide(m) for m in row["means"].values())]
        for row in rows
    ]
    return "\n\n".join([provenance(runs, trials), markdown_table([head, *body]), _DRAWN]) + "\n"


class Shown(NamedTuple):
    """Markdown that shows pictures: of all policies compared, of every agent, of how a run goes."""

    compared: str
    agents: str
    course: str


_NOTHING_SHOWN = Shown("", "", "")


def markdown(
    runs: Sequence[RunFigures],
    trials: Sequence[Trial],
    base: str,
    failed: Sequence[str] = (),
    shown: Shown = _NOTHING_SHOWN,
) -> str:
    """All policies against `base`. failed: runs that came to nothing, by name."""
    names = policies(runs)
    parts = [
        "# Policies compared",
        provenance(runs, trials, failed),
        f"## Each policy, and as a part of `{base}`",
        _comparison(runs, names, base),
        "Values: means over all runs that have one. Parts: of pairs of runs of one session, link and seed; "
        f"(n of N): not both have it in all pairs. {_DRAWN}",
        shown.compared,
    ]
    others = [name for name in names if name != names[0]]
    if others:
        parts += [f"## Errors by `{names[0]}`", *(_wins(runs, names[0], other) for other in others)]
    parts += ["## Every agent", shown.agents, _every_agent(runs, names), shown.course]
    return "\n\n".join(part for part in parts if part) + "\n"


def provenance(runs: Sequence[RunFigures], trials: Sequence[Trial], failed: Sequence[str] = ()) -> str:
    """What was played, where, when, by which code, and how it is scored: a Markdown list."""
    records = [trial.record for trial in trials]
    conditions = [run.conditions for run in runs]
    machines = {
        f"{r['machine']['cpu']}, {r['machine']['cores']} cores, {r['machine']['system']}" for r in records
    }
    loads = [r["machine"]["load"] for r in records]
    told = [
        f"{len(runs)} runs in {_each(c.clock for c in conditions)}, "
        f"{min(r['began'] for r in records)} to {max(r['began'] for r in records)}.",
        *([f"NOT played, and nowhere below: {', '.join(failed)}."] if failed else []),
        f"Policies: {_each(c.policy for c in conditions)}; sessions: {_each(c.session for c in conditions)}; "
        f"links: {_each(c.link or 'loopback' for c in conditions)}; "
        f"seeds: {_each(str(c.seed) for c in conditions)}.",
        f"Machine: {'; '.join(sorted(machines))}; load before a run {min(loads):g} to {max(loads):g}.",
        f"SHARE {_each(r['version'] for r in records)}, {_code(conditions)}; "
        f"evaluations tell {_each(c.told for c in conditions)}.",
    ]
    return "\n".join([*(f"* {line}" for line in told), bullets(PROTOCOL)])


def _each(names: Iterable[str]) -> str:
    return ", ".join(sorted(set(names)))


def _code(conditions: Sequence[Conditions]) -> str:
    """By which state of the code; runs of several may differ for that alone."""
    runs_by = Counter(c.code or "unknown" for c in conditions)
    if len(runs_by) == 1:
        return f"code {next(iter(runs_by))}"
    return "SEVERAL STATES OF THE CODE: " + ", ".join(f"{code} ({n} runs)" for code, n in runs_by.items())


def _comparison(runs: Sequence[RunFigures], names: Sequence[str], base: str) -> str:
    found = {name: compare(runs, name, base) for name in names}
    rows = [["", *names]]
    for k, measure in enumerate(MEASURES):
        cells = []
        for name in names:
            one = found[name][k]
            ratio = "" if name == base else f"; {_part(one)}"
            cells.append(number(one.value.value) + ratio)
        rows.append([measure.titled, *cells])
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


def _part(of: Compared) -> str:
    partly = f" ({of.pairs} of {of.of})" if 0 < of.pairs < of.of else ""
    return _told(of.ratio, ".2f") + partly


def _wide(of: Interval) -> str:
    return _told(of, ".3g")


def _told(of: Interval, form: str) -> str:
    """A dash where it is not known; alone where one session cannot say how sure it is."""
    if math.isnan(of.value):
        return "–"
    between = "" if math.isnan(of.low) else f" [{of.low:{form}}, {of.high:{form}}]"
    return f"{of.value:{form}}{between}"
