"""Trackers side by side, as text and pictures."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median

import numpy as np

from share import __version__
from share.lab.evaluate.charts import draw_bars
from share.lab.evaluate.peer_comparison import TrackerRow
from share.lab.evaluate.provenance import describe_machine
from share.lab.evaluate.report import bullets, csv_text, format_number, image_link, markdown_table

PROTOCOL = (
    "causal poses of all frames, as each tracker gave them at the time; truth interpolated at their stamps",
    "ATE: rms under one SE3 alignment; RPE: rms over 1 s, no alignment; docs/do/evaluate.md",
    "CPU: process time of all threads, without decoding; SHARE's includes its keyframes",
    "'final trajectory': not causal; the trajectory by the tracker's final map",
)


def rows_csv(rows: Sequence[TrackerRow]) -> str:
    """Return a line per row."""
    return csv_text([f.name for f in dataclasses.fields(TrackerRow)], map(dataclasses.astuple, rows))


def markdown(rows: Sequence[TrackerRow], missing: Sequence[str]) -> str:
    """Return the table, with medians where there are several recordings, and the protocol. `missing`: why
    trackers were left out."""
    head = ("recording", "tracker", "ATE cm", "max cm", "RPE 1 s cm", "RPE 1 s °", "tracked %")
    cpu = ("CPU ms per frame: median", "mean", "p99")
    body = [_cells(row) for row in rows]
    if len({row.recording for row in rows}) > 1:
        body += [_cells(row) for row in _medians(rows)]
    machine = describe_machine()
    lines = [
        "# Trackers side by side",
        markdown_table([[*head, *cpu], *body]),
        bullets(
            (
                *PROTOCOL,
                f"machine: {machine['cpu']}, {machine['cores']} cores; SHARE {__version__}",
                *(f"left out: {text}" for text in missing),
            )
        ),
    ]
    return "\n\n".join(lines) + "\n"


def _medians(rows: Sequence[TrackerRow]) -> Iterator[TrackerRow]:
    """Yield a row per tracker: medians over the recordings where it has values."""
    for tracker in dict.fromkeys(row.tracker for row in rows):
        tracker_rows = [row for row in rows if row.tracker == tracker]
        values = [
            median(known)
            if (known := [v for row in tracker_rows if not math.isnan(v := getattr(row, f.name))])
            else math.nan
            for f in dataclasses.fields(TrackerRow)[3:]
        ]
        yield TrackerRow(
            f"median of {len(tracker_rows)}", tracker, sum(row.frames for row in tracker_rows), *values
        )


def _cells(row: TrackerRow) -> list[str]:
    cm = [format_number(value, ".2f") for value in (row.ate_cm, row.most_cm, row.rpe_1s_cm, row.rpe_1s_deg)]
    cpu = [format_number(value, ".1f") for value in (row.cpu_ms, row.cpu_mean_ms, row.cpu_p99_ms)]
    return [row.recording, row.tracker, *cm, f"{100 * row.told:.1f}", *cpu]


def draw_comparison(folder: Path, rows: Sequence[TrackerRow]) -> str:
    """Write PNG files to `folder`; return the Markdown that shows them."""
    recordings = list(dict.fromkeys(row.recording for row in rows))
    trackers = list(dict.fromkeys(row.tracker for row in rows))
    row_of = {(row.recording, row.tracker): row for row in rows}

    def values(field: str) -> dict[str, list[float]]:
        return {
            tracker: [getattr(row_of.get((one, tracker)), field, math.nan) for one in recordings]
            for tracker in trackers
        }

    draw_bars(
        folder / "errors.png",
        {"ATE": values("ate_cm"), "RPE over 1 s": values("rpe_1s_cm")},
        recordings,
        "cm",
    )
    causal = {
        tracker: values_ms
        for tracker, values_ms in values("cpu_mean_ms").items()
        if not np.isnan(values_ms).all()
    }
    draw_bars(folder / "cpu.png", {"mean CPU per frame": causal}, recordings, "ms")
    errors = image_link("Errors of each tracker", "errors.png")
    cpu = image_link("CPU time of each tracker", "cpu.png")
    return f"{errors}\n\n{cpu}\n"
