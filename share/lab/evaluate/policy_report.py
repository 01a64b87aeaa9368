"""The report of policies compared: a headline, tables of one quantity a cell with the best in bold, LaTeX."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from share.files.json_file import nan_to_none
from share.lab.evaluate.report import provenance
from share.lab.evaluate.run_metrics import RunMetrics
from share.lab.evaluate.statistics import (
    Interval,
    Measure,
    PolicyComparison,
    compare_policies,
    count_no_worse,
    count_no_worse_on_average,
    policy_names,
)
from share.lab.evaluate.trial import Trial
from share.lab.tables import format_number, latex_tabular, markdown_table

_HEADLINE = ("AR latency", "merges per metre", "joint ATE")  # measures in the first sentence
_INTERVAL_NOTE = "95 %: confidence intervals by bootstrap over sessions, each with all its runs."
_VALUES_NOTE = (
    "Means over runs that have a value; the best of a row in bold, unless all are equal or neither more nor "
    "less is better (estimated errors, keyframes sent)."
)
_RATIOS_NOTE = "Ratios over pairs of runs of equal session, link and seed."
_Comparisons = Mapping[str, Sequence[PolicyComparison]]  # by policy, in the order of `MEASURES`


class ReportPictures(NamedTuple):
    """Markdown that shows the pictures: of the policies compared, of every agent, and of a run over time."""

    comparison: str
    agents: str
    timeline: str


_NO_PICTURES = ReportPictures("", "", "")


def markdown(
    runs: Sequence[RunMetrics],
    trials: Sequence[Trial],
    base: str,
    failed: Sequence[str] = (),
    pictures: ReportPictures = _NO_PICTURES,
) -> str:
    """Return the report: all policies against `base`. `failed`: names of runs that failed."""
    names = policy_names(runs)
    compared = {name: compare_policies(runs, name, base) for name in names}
    other_policies = [name for name in names if name != base]
    parts = ["# Policies compared", _headline(compared, base), _meetings(runs, names)]
    if failed:
        parts.append(f"FAILED, and not in this report: {', '.join(failed)}.")
    parts += ["## Each policy", markdown_table(_values(compared)), _VALUES_NOTE]
    if other_policies:
        note = _RATIOS_NOTE + (f" {_INTERVAL_NOTE}" if _has_intervals(compared) else "")
        parts += [f"## Ratios to `{base}`", _ratios(compared, other_policies), note, pictures.comparison]
        subject = other_policies[0]  # of the first, in whatever order they are named
        others = [name for name in names if name != subject]
        parts += [
            f"## Errors with `{subject}`",
            "\n".join(_win_count(runs, subject, other) for other in others),
        ]
    parts += ["## Every agent", pictures.agents]
    for title, field in (("Latency, ms", "latency_ms"), ("ATE in the map, cm", "ate_cm")):
        if table := _agent_table(runs, names, field):
            parts += [f"### {title}", table]
    parts += [pictures.timeline, "## How it was measured", provenance(runs, trials)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _headline(compared: _Comparisons, base: str) -> str:
    """Return what the first policy beside the base reaches of it."""
    subject = next((name for name in compared if name != base), None)
    if subject is None:
        return ""
    sentences = []
    for mine in compared[subject]:
        if mine.measure.name not in _HEADLINE or math.isnan(mine.ratio.value):
            continue
        unit = f" {mine.measure.unit}" if mine.measure.unit in ("ms", "cm") else ""
        sentences.append(
            f"{mine.measure.name} {format_number(mine.value.value)}{unit}, "
            f"{format_number(mine.ratio.value, '.2f')} of `{base}`'s"
        )
    return f"**`{subject}`: {'; '.join(sentences)}, in the same runs.**" if sentences else ""


def _meetings(runs: Sequence[RunMetrics], names: Sequence[str]) -> str:
    """Return in how many runs agents came to share a map; "" where they did in all."""
    met = {
        name: [run.agents_in_largest_map >= 2 for run in runs if run.conditions.policy == name]
        for name in names
    }
    if all(map(all, met.values())):
        return ""
    if not any(map(any, met.values())):
        return (
            f"**No agents met in any of the {len(runs)} runs, so no map was shared:** this report says "
            "nothing of merges and of errors in a shared map. Longer sessions, or paths that cross, would."
        )
    counts = ", ".join(f"{sum(of)} of {len(of)} with `{name}`" for name, of in met.items())
    return f"Agents came to share a map in not all runs: {counts}."


def _known_measures(compared: _Comparisons) -> list[tuple[int, Measure]]:
    """Return the measures of which any policy has a value, with their numbers."""
    first = next(iter(compared.values()))
    return [
        (k, one.measure)
        for k, one in enumerate(first)
        if any(not math.isnan(rows[k].value.value) for rows in compared.values())
    ]


def _values(compared: _Comparisons) -> list[list[str]]:
    """Return a table of the policies' values."""
    rows = [["", *compared]]
    for k, measure in _known_measures(compared):
        cells = best_in_bold([of[k].value.value for of in compared.values()], measure.better)
        rows.append([measure.title, *cells])
    return rows


def best_in_bold(values: Sequence[float], better: int) -> list[str]:
    """Return values as text, the best of several in bold. better: as in `Measure`."""
    texts = [format_number(value) for value in values]
    known = [better * value for value in values if not math.isnan(value)]
    if not better or len(known) < 2:
        return texts
    best = format_number(better * max(known))
    if all(text == best for text in texts):
        return texts
    return [f"**{text}**" if text == best else text for text in texts]


def _has_intervals(compared: _Comparisons) -> bool:
    return any(math.isfinite(one.ratio.low) for rows in compared.values() for one in rows)


def _ratios(compared: _Comparisons, other_policies: Sequence[str]) -> str:
    """Return the ratios; with intervals, and the number of pairs where not all have both values."""
    has_intervals, head = _has_intervals(compared), [""]
    for name in other_policies:
        is_partly = any(0 < one.pairs < one.total_pairs for one in compared[name])
        head += [name, *(["95 %"] if has_intervals else []), *(["pairs"] if is_partly else [])]
    rows = [head]
    for k, measure in _known_measures(compared):
        row = [measure.name]
        for name in other_policies:
            one = compared[name][k]
            is_partly = any(0 < other.pairs < other.total_pairs for other in compared[name])
            row.append(format_number(one.ratio.value, ".2f"))
            row += [_bounds(one.ratio)] if has_intervals else []
            row += [f"{one.pairs} of {one.total_pairs}"] if is_partly else []
        if any(cell != "–" for cell in row[1:]):
            rows.append(row)
    return markdown_table(rows)


def _bounds(interval: Interval) -> str:
    return "–" if math.isnan(interval.low) else f"{interval.low:.2f} to {interval.high:.2f}"


def _win_count(runs: Sequence[RunMetrics], name: str, other: str) -> str:
    wins, total = count_no_worse(runs, name, other)
    if not total:
        return (
            f"* against `{other}`: no agent was in a shared map with both, so there are no errors to compare"
        )
    means, total_means = count_no_worse_on_average(runs, name, other)
    return (
        f"* against `{other}`: {wins} of {total} ATEs in the shared map are no larger (an agent's, in runs "
        f"in which it shared a map with both), and {means} of {total_means} of their means over an agent's "
        "runs on a session"
    )


def _agent_table(runs: Sequence[RunMetrics], names: Sequence[str], field: str) -> str:
    """Return a table of one quantity, a row for each agent on each session; "" where no run has it."""
    rows = [["session", "agent", *names]]
    for session in dict.fromkeys(run.conditions.session for run in runs):
        for agent in dict.fromkeys(
            a.agent for r in runs if r.conditions.session == session for a in r.agents
        ):
            values = [agent_mean(runs, name, session, agent, field) for name in names]
            if not all(map(math.isnan, values)):
                rows.append([session, agent, *best_in_bold(values, -1)])
    return markdown_table(rows) if len(rows) > 1 else ""


def agent_mean(runs: Sequence[RunMetrics], policy: str, session: str, agent: str, field: str) -> float:
    """Return the mean of a field of an agent over the runs of a policy on a session, NaN without any."""
    values = [
        getattr(one, field)
        for run in runs
        if run.conditions.policy == policy and run.conditions.session == session
        for one in run.agents
        if one.agent == agent
    ]
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan


def comparison_document(runs: Sequence[RunMetrics], base: str) -> dict[str, Any]:
    """Return the values and ratios of all policies as plain data."""
    policies = {
        name: {
            one.measure.name: {
                "unit": one.measure.unit,
                "value": nan_to_none(one.value._asdict()),
                "ratio": nan_to_none(one.ratio._asdict()),
                "pairs": one.pairs,
            }
            for one in compare_policies(runs, name, base)
        }
        for name in policy_names(runs)
    }
    return {"base": base, "runs": len(runs), "policies": policies}


def latex_table(runs: Sequence[RunMetrics], base: str) -> str:
    """Return a LaTeX tabular of the policies' values, the best in bold."""
    compared = {name: compare_policies(runs, name, base) for name in policy_names(runs)}
    note = f"% {len(runs)} runs; means over runs that have a value; best in bold"
    return f"{note}\n{latex_tabular(_values(compared))}\n"
