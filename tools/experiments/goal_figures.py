"""Tables and a plot of the lines that `measure_goals` writes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tool_main import line

from share.colours import series_colours
from share.lab.evaluate.charts import agg_pyplot, save_png
from share.lab.robot.goals import REACHED_M

HEAD = ("run", "rooms", "goals", "reached", "said so and was not there", "given again", "final error, m")
HEAD += ("time, s", "place error, m")
FAILED_HEAD = ("run", "seed", "goal", "error, m", "time, s", "tries", "said")
_MOST_ERROR_M = 1.0  # drawn
_SAID = 90

Row = dict[str, Any]


def print_tables(rows: Sequence[Row]) -> None:
    """Print the figures of each run and mode, and the goals that were not reached."""
    print("\n".join(line(cells) for cells in (HEAD, ["---"] * len(HEAD))))
    for name, goals in by_run(rows).items():
        print(line(cells_of(name, goals, [row for row in rows if is_of(row, name) and row["kind"] == "run"])))
    failed = [row for row in rows if row["kind"] == "goal" and not row["reached"]]
    print("\n".join(["", *(line(cells) for cells in (FAILED_HEAD, ["---"] * len(FAILED_HEAD)))]))
    for row in failed:
        cells = [run_name(row), row["seed"], row["number"], f"{row['error_m']:.2f}", f"{row['seconds']:.0f}"]
        print(line(map(str, [*cells, row["attempts"], row["text"][:_SAID]])))


def run_name(row: Row) -> str:
    return str(row["run"]) if row["mode"] is None else f"{row['run']}, {row['mode']}"


def is_of(row: Row, name: str) -> bool:
    return run_name(row) == name


def by_run(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the goals that came to an end, by run and mode."""
    out: dict[str, list[Row]] = {}
    for row in rows:
        if row["kind"] == "goal":
            out.setdefault(run_name(row), []).append(row)
    return out


def cells_of(name: str, goals: Sequence[Row], runs: Sequence[Row]) -> list[str]:
    """Return a line of the table. runs: those that were finished."""
    reached = sum(row["reached"] for row in goals)
    places = [row["place_error_m"] for row in runs if row["place_error_m"] is not None]
    missing = sum(row["goals"] - row["ended"] for row in runs)
    return [
        name,
        str(len({row["seed"] for row in goals})),
        f"{len(goals)}" + (f" ({missing} more not in time)" if missing else ""),
        f"{reached}, {100 * reached / len(goals):.0f} %",
        str(sum(row["says_reached"] and not row["reached"] for row in goals)),
        str(sum(row["attempts"] > 1 for row in goals)),
        spread([row["error_m"] for row in goals], 2),
        spread([row["seconds"] for row in goals], 0),
        f"{np.median(places):.3f}" if places else "-",
    ]


def spread(values: Sequence[float], digits: int) -> str:
    """Return median, 95th percentile and maximum."""
    median, high = np.percentile(values, (50, 95))
    return f"{median:.{digits}f} ({high:.{digits}f}, {max(values):.{digits}f})"


def draw_goals(path: Path, rows: Sequence[Row]) -> None:
    """Write a PNG: how many goals ended within an error, and within a time, by run."""
    pyplot = agg_pyplot()
    runs = by_run(rows)
    colours = series_colours(runs)
    figure, axes = pyplot.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained", sharey=True)
    for name, goals in runs.items():
        for axis, figures in zip(axes, ("error_m", "seconds"), strict=True):
            values = np.sort([row[figures] for row in goals])
            steps = 100 * np.arange(len(values) + 1) / len(values)
            last = [*values, max(values[-1], _MOST_ERROR_M if figures == "error_m" else 0)]
            label = f"{name} (n {len(goals)})"
            axis.step(np.r_[0, last], np.r_[steps, 100], where="post", label=label, color=colours[name])
    axes[0].axvline(REACHED_M, color="black", linewidth=1, linestyle="--")
    axes[0].set(xlim=(0, _MOST_ERROR_M), xlabel="true final error, m", ylabel="% of goals")
    axes[1].set(xlabel="time, s")
    for axis in axes:
        axis.grid(alpha=0.3)
    axes[0].legend(frameon=False, loc="center right", bbox_to_anchor=(1.0, 0.65))
    save_png(figure, path, 100)
