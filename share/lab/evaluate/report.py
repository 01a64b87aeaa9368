"""Results of trials as text: CSV for programs, Markdown and HTML for readers."""

from __future__ import annotations

import base64
import dataclasses
import html
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from share.errors import DataError, UsageError
from share.files.reading import MAX_SETTINGS_BYTES, path_inside, read_text
from share.lab.evaluate.run_metrics import AgentMetrics, Conditions, RunMetrics
from share.lab.evaluate.statistics import MEASURES
from share.lab.evaluate.trial import Trial
from share.lab.tables import csv_text, format_number, markdown_table
from share.lab.train.score import read_scores, score_table
from share.recordings.images import read_picture


def bullets(texts: Iterable[str]) -> str:
    """Return a Markdown list of sentences."""
    return "\n".join(f"* {text[0].upper()}{text[1:]}." for text in texts)


def image_link(caption: str, name: str) -> str:
    """Return a Markdown image paragraph; `name`: a file beside the text."""
    return f"![{caption}]({name})"


# Extra sections of a report: sweeps of settings, comparisons of error models.

SWEEP, HEAT_MAP = "sweep.md", "heat.png"


@dataclass(frozen=True)
class ReportSection:
    """An extra section of a report. `text`: Markdown with a heading. `pictures`: PNG files by the names
    under which the text shows them."""

    text: str
    pictures: dict[str, Path]


def read_section(path: Path, number: int) -> ReportSection:
    """Read an extra section, the report's `number`th, from a folder of `share evaluate sweep` or a file of
    `share train compare --json`.

    Raises UsageError for anything else, DataError for a damaged one.
    """
    if path.is_file():
        return ReportSection(f"## Error models: {path.stem}\n\n{score_table(read_scores(path))}\n", {})
    if not (path / SWEEP).is_file():
        raise UsageError(
            f"--with {path}: give a folder of `share evaluate sweep`, "
            "or a file of `share train compare --json`"
        )
    heat = path / HEAT_MAP
    text = f"## Settings swept: {path.name}\n\n{_section_text(path / SWEEP)}"
    if not heat.is_file():
        return ReportSection(text, {})
    name = f"heat-{number}.png"
    return ReportSection(f"{text}\n{image_link('Means over the first two settings', name)}\n", {name: heat})


def _section_text(path: Path) -> str:
    try:
        return read_text(path, MAX_SETTINGS_BYTES)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise DataError(f"{path}: cannot be read: {reason}") from None


_AGENT_COLUMNS = [field.name for field in dataclasses.fields(AgentMetrics)]
_CONDITION_COLUMNS = [field.name for field in dataclasses.fields(Conditions)]
_RUN_COLUMNS = (
    "agents_in_largest_map",
    "joint_ate_cm",
    "merges_requested",
    "merges_skipped",
    "merges_done",
    "merges_per_metre",
)
PROTOCOL = (
    "latency: mean over the track_ms of all frames and all corrected_ms together; ms from a frame's arrival",
    "poses: causal, of all tracked frames; truth interpolated at their stamps over at most 100 ms",
    "odom ATE: rms, each agent SE3-aligned alone; map ATE: rms, one SE3 alignment for all agents in a map",
    "RPE: rms of poses in the map, from frame to frame and over 1 s, no alignment; docs/do/evaluate.md",
)
_INTERVAL_NOTE = (
    "sweep.csv also has 95 % confidence intervals, by bootstrap over sessions, each with all its runs."
)


def agents_csv(runs: Iterable[RunMetrics]) -> str:
    """Return a line per agent and run."""
    return csv_text(
        [*_CONDITION_COLUMNS, *_AGENT_COLUMNS],
        (
            [*_condition_values(run), *(getattr(agent, f) for f in _AGENT_COLUMNS)]
            for run in runs
            for agent in run.agents
        ),
    )


def runs_csv(runs: Iterable[RunMetrics]) -> str:
    """Return a line per run."""
    return csv_text(
        [*_CONDITION_COLUMNS, *_RUN_COLUMNS, "metres"],
        ([*_condition_values(run), *(getattr(run, f) for f in _RUN_COLUMNS), run.metres] for run in runs),
    )


def sweep_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a line per point; `rows` as from `share.lab.evaluate.sweep.sweep_table`."""
    columns = [f"{name}{of}" for name in rows[0]["means"] for of in ("", " low", " high")]
    return csv_text(
        [*rows[0]["settings"], "runs", *columns],
        (
            [*row["settings"].values(), row["runs"], *(bound for m in row["means"].values() for bound in m)]
            for row in rows
        ),
    )


def sweep_markdown(
    rows: Sequence[Mapping[str, Any]], runs: Sequence[RunMetrics], trials: Sequence[Trial]
) -> str:
    """Return the sweep's table and provenance as Markdown."""
    titles = {measure.name: measure.title for measure in MEASURES}
    head = [*rows[0]["settings"], "runs", *(titles[name] for name in rows[0]["means"])]
    body = [
        [
            *row["settings"].values(),
            str(row["runs"]),
            *(format_number(m.value) for m in row["means"].values()),
        ]
        for row in rows
    ]
    has_intervals = any(math.isfinite(m.low) for row in rows for m in row["means"].values())
    note = [_INTERVAL_NOTE] if has_intervals else []
    return "\n\n".join([markdown_table([head, *body]), *note, provenance(runs, trials)]) + "\n"


def provenance(runs: Sequence[RunMetrics], trials: Sequence[Trial]) -> str:
    """Return a Markdown list: what was played, where, when, by which code, and how it is scored."""
    records = [trial.record for trial in trials]
    conditions = [run.conditions for run in runs]
    machines = {
        f"{r['machine']['cpu']}, {r['machine']['cores']} cores, {r['machine']['system']}" for r in records
    }
    loads = [r["machine"]["load"] for r in records]
    lines = [
        f"{len(runs)} runs in {_joined_names(c.clock for c in conditions)}, "
        f"{min(r['began'] for r in records)} to {max(r['began'] for r in records)}.",
        f"Policies: {_joined_names(c.policy for c in conditions)}; "
        f"sessions: {_joined_names(c.session for c in conditions)}; "
        f"links: {_joined_names(c.link or 'loopback' for c in conditions)}; "
        f"seeds: {_joined_names(str(c.seed) for c in conditions)}.",
        f"Machine: {'; '.join(sorted(machines))}; load before a run: {min(loads):g} to {max(loads):g}.",
        f"SHARE {_joined_names(r['version'] for r in records)}, {_code_states(conditions)}; "
        f"estimated errors from {_joined_names(c.error_source for c in conditions)}.",
    ]
    return "\n".join([*(f"* {line}" for line in lines), bullets(PROTOCOL)])


def _joined_names(names: Iterable[str]) -> str:
    return ", ".join(sorted(set(names)))


def _code_states(conditions: Sequence[Conditions]) -> str:
    """Return the state of the code, or a warning that runs are of several states, which may differ for
    that alone."""
    runs_by = Counter(c.code or "unknown" for c in conditions)
    if len(runs_by) == 1:
        return f"code {next(iter(runs_by))}"
    return "SEVERAL STATES OF THE CODE: " + ", ".join(f"{code} ({n} runs)" for code, n in runs_by.items())


def _condition_values(run: RunMetrics) -> list[object]:
    return [getattr(run.conditions, name) for name in _CONDITION_COLUMNS]


_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem;
  color: #222; }
h1, h2 { line-height: 1.2; } h2 { margin-top: 2.5rem; border-bottom: 1px solid #ccc; }
table { border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums; display: block;
  overflow-x: auto; }
th, td { padding: 0.25rem 0.75rem; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } th { background: #f3f3f3; }
tbody tr:hover { background: #f8f8f0; } td strong { color: #00626f; } li { overflow-wrap: anywhere; }
h1 + p { font-size: 1.15rem; }
@media (max-width: 40rem) {
  body { font-size: 15px; margin: 1rem auto; padding: 0 .8rem; } ul { padding-left: 1.2rem; }
  table { font-size: 13px; } th, td { padding: .25rem .5rem; }
  th:first-child, td:first-child { position: sticky; left: 0; background: #fff; white-space: normal; }
  th:first-child { background: #f3f3f3; }
}
figure { margin: 1.5rem 0; } img { max-width: 100%; } figcaption { color: #555; font-size: 14px; }
"""
_PICTURE = re.compile(r'<p><img alt="([^"]*)" src="([^"]*)" ?/?></p>')


def html_page(title: str, text: str, folder: Path) -> str:
    """Return HTML of a Markdown text. HTML in the text is escaped.

    Pictures are PNG files in `folder`, each a paragraph of its own; its alt text becomes the caption.
    """
    from markdown import markdown
    from markdown.extensions.tables import TableExtension  # imported by class, so that a freezer sees it

    body = markdown(html.escape(text, quote=False), extensions=[TableExtension()])
    body = _PICTURE.sub(partial(_figure_html, folder), body)
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width">\n<title>{html.escape(title)}</title>\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _figure_html(folder: Path, match: re.Match[str]) -> str:
    caption, name = match[1], html.unescape(match[2])
    data = base64.b64encode(read_picture(path_inside(folder, name, "a report"))).decode()
    return (
        f'<figure>\n<img alt="{caption}" src="data:image/png;base64,{data}">\n'
        f"<figcaption>{caption}</figcaption>\n</figure>"
    )
