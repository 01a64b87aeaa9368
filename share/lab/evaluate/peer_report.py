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
from share.lab.evaluate.peer_comparison import Row
from share.lab.evaluate.report import bullets, csv_text, markdown_table, number, picture
from share.runtime.machine import describe_machine

PROTOCOL = (
    "causal poses of all frames, as each tracker told them at the time; truth interpolated at their stamps",
    "ATE: rms under one SE3 alignment; RPE: rms over 1 s, without one; docs/evaluation.md",
    "CPU: process time of all threads, decoding apart; ours with its keyframes",
    "'in the end': not causal, the trajectory by the map that a tracker has when all is over",
)


def csv_of(found: Sequence[Row]) -> str:
    """A line a row."""
    return csv_text([f.name for f in dataclasses.fields(Row)], map(dataclasses.astuple, found))


def markdown(found: Sequence[Row], lacking: Sequence[str]) -> str:
    """The table, medians where there are several recordings, and the protocol."""
    head = ("recording", "tracker", "ATE cm", "most cm", "RPE 1 s cm", "°", "with a pose %")
    cpu = ("CPU ms a frame", "mean", "p99")
    body = [_cells(row) for row in found]
    if len({row.recording for row in found}) > 1:
        body += [_cells(row) for row in _medians(found)]
    machine = describe_machine()
    lines = [
        "# Trackers side by side",
        markdown_table([[*head, *cpu], *body]),
        bullets(
            (
                *PROTOCOL,
                f"machine: {machine['cpu']}, {machine['cores']} cores; SHARE {__version__}",
                *(f"left out: {text}" for text in lacking),
            )
        ),
    ]
    return "\n\n".join(lines) + "\n"


def _medians(found: Sequence[Row]) -> Iterator[Row]:
    """Of each tracker, over the recordings where it has figures."""
    for tracker in dict.fromkeys(row.tracker for row in found):
        mine = [row for row in found if row.tracker == tracker]
        values = [
            median(known)
            if (known := [v for row in mine if not math.isnan(v := getattr(row, f.name))])
            else math.nan
            for f in dataclasses.fields(Row)[3:]
        ]
        yield Row(f"median of {len(mine)}", tracker, sum(row.frames for row in mine), *values)


def _cells(row: Row) -> list[str]:
    cm = [number(value, ".2f") for value in (row.ate_cm, row.most_cm, row.rpe_1s_cm, row.rpe_1s_deg)]
    cpu = [number(value, ".1f") for value in (row.cpu_ms, row.cpu_mean_ms, row.cpu_p99_ms)]
    return [row.recording, row.tracker, *cm, f"{100 * row.told:.1f}", *cpu]


def draw(folder: Path, found: Sequence[Row]) -> str:
    """PNG files in `folder`; the Markdown that shows them."""
    recordings, trackers = (
        list(dict.fromkeys(getattr(r, f) for r in found)) for f in ("recording", "tracker")
    )
    by = {(row.recording, row.tracker): row for row in found}

    def values(field: str) -> dict[str, list[float]]:
        return {
            tracker: [getattr(by.get((one, tracker)), field, math.nan) for one in recordings]
            for tracker in trackers
        }

    draw_bars(
        folder / "errors.png",
        {"ATE": values("ate_cm"), "RPE over 1 s": values("rpe_1s_cm")},
        recordings,
        "cm",
    )
    causal = {tracker: told for tracker, told in values("cpu_mean_ms").items() if not np.isnan(told).all()}
    draw_bars(folder / "cpu.png", {"CPU a frame, mean": causal}, recordings, "ms")
    errors, cpu = picture("Errors of each tracker", "errors.png"), picture("What they take", "cpu.png")
    return f"{errors}\n\n{cpu}\n"
