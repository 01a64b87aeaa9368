"""Figures of trials as text: CSV for a program, Markdown for a reader."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from share.errors import DataError, UsageError
from share.files.reading import SETTINGS, read_text
from share.lab.evaluate.figures import AgentFigures, Conditions, RunFigures
from share.lab.evaluate.statistics import (
    MEASURES,
    Compared,
    Interval,
    compare,
    no_worse,
    no_worse_on_average,
    policies,
)
from share.lab.evaluate.trial import Trial
from share.lab.train.score import read_scores, table

# ---- Tables as text: CSV for a program, Markdown for a reader; what is not known is empty, or a dash.


def csv_text(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Numbers to six digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    for row in rows:
        writer.writerow([_cell(value) for value in row])
    return text.getvalue()


def _cell(value: object) -> object:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return value


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """The first of `rows` is its head."""
    head, *body = rows
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *body))


def bullets(texts: Iterable[str]) -> str:
    """A Markdown list of sentences."""
    return "\n".join(f"* {text[0].upper()}{text[1:]}." for text in texts)


def picture(said: str, name: str) -> str:
    """Of Markdown, a paragraph of its own. name: of a file beside it."""
    return f"![{said}]({name})"


def number(value: float, form: str = ".3g") -> str:
    return "–" if math.isnan(value) else format(value, form)


# ---- What else a report may hold, by who made it: settings that were tried, models of the error compared.

SWEEP, HEAT = "sweep.md", "heat.png"


@dataclass(frozen=True)
class Annex:
    """text: Markdown with a heading. pictures: PNG files that it shows, by the names that it has for them."""

    text: str
    pictures: dict[str, Path]


def annex(path: Path, number: int) -> Annex:
    """Of a folder by `share evaluate sweep`, or a file by `share train compare --json`: a report's first or
    `number`th. Raises UsageError for anything else, DataError for a damaged one."""
    if path.is_file():
        return Annex(f"## Models of the error: {path.stem}\n\n{table(read_scores(path))}\n", {})
    if not (path / SWEEP).is_file():
        raise UsageError(
            f"--with {path}: give a folder by `share evaluate sweep`, "
            f"or a file by `share train compare --json`"
        )
    heat = path / HEAT
    text = f"## Settings tried: {path.name}\n\n{_text(path / SWEEP)}"
    if not heat.is_file():
        return Annex(text, {})
    name = f"heat-{number}.png"
    return Annex(f"{text}\n{picture('Means over the first two settings', name)}\n", {name: heat})


def _text(path: Path) -> str:
    try:
        return read_text(path, SETTINGS)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise DataError(f"{path}: cannot be read: {reason}") from None


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
    """A line a point; rows: by `share.lab.evaluate.sweep.table`."""
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
