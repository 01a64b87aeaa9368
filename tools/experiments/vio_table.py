"""Runs as a Markdown table: a line a sequence, median over seeds and in brackets the worst."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

Row = dict[str, Any]


class _Column(NamedTuple):
    """key: of a run's figures; times: unit conversion; worst: function that picks the worst of several."""

    title: str
    key: str
    form: str
    times: float = 1.0
    worst: Callable[[list[float]], float] = max


COLUMNS = (
    _Column("ATE cm", "ate_cm", ".2f"),
    _Column("most cm", "worst_cm", ".2f"),
    _Column("RPE 1 s cm", "rpe_1s_cm", ".2f"),
    _Column("RPE 1 s °", "rpe_1s_deg", ".3f"),
    _Column("OK %", "OK", ".1f", 100, min),
    _Column("with a pose %", "told", ".1f", 100, min),
    _Column("LOST s", "lost_s", ".1f"),
    _Column("new segments", "new_stretches", ".0f"),
    _Column("ready s", "init_s", ".2f"),
    _Column("CPU ms", "track_ms", ".1f"),
    _Column("p99", "track_p99_ms", ".1f"),
    _Column("keyframe ms", "keyframe_ms", ".1f"),
    _Column("NEES position", "nees_position", ".2f"),
    _Column("orientation", "nees_orientation", ".2f"),
    _Column("in 3σ % position", "inside_position", ".1f", 100, min),
    _Column("orientation", "inside_orientation", ".1f", 100, min),
)


def table(rows: Iterable[Row]) -> str:
    """Return the table of runs of any sequences and seeds, in their order."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row["sequence"], []).append(row)
    lines = [line(["sequence", "seeds", *(column.title for column in COLUMNS)])]
    lines.append(line(["---"] * (2 + len(COLUMNS))))
    for name, runs in groups.items():
        seeds = " ".join(str(run["seed"]) for run in runs)
        lines.append(line([name, seeds, *(_cell(column, runs) for column in COLUMNS)]))
    return "\n".join(lines)


def _cell(column: _Column, runs: list[Row]) -> str:
    """Return a cell; a missing figure counts as the worst."""
    found = [(run | run["states"])[column.key] for run in runs]
    values = [column.times * value for value in found if value is not None]
    if not values:
        return "none"
    middle = format(float(np.median(values)), column.form)
    worst = format(column.worst(values), column.form) if len(values) == len(found) else "none"
    return middle if middle == worst else f"{middle} ({worst})"


def line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"
