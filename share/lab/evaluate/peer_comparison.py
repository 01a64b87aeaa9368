"""SHARE's tracker and peers on the same recordings: a stored row of metrics each, and a report."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from share import __version__
from share.config import Config
from share.errors import DataError, UsageError
from share.files.json_file import nan_to_none, none_to_nan, read_json, to_plain
from share.files.writing import atomic_write
from share.lab.evaluate.charts import draw_bars
from share.lab.evaluate.provenance import describe_machine
from share.lab.evaluate.report import bullets, image_link
from share.lab.evaluate.tracker_runs import TrackerRun, can_run_peers, peer_version, run_peer, run_share
from share.lab.peer_trackers import PEERS
from share.lab.tables import csv_text, format_number, markdown_table
from share.metrics.ate import ate
from share.metrics.rpe import rpe_time
from share.plain_data import to_mapping
from share.recordings.trajectory import Trajectory, format_tum
from share.runtime.source import Source

_FINAL_SUFFIX = ", final trajectory"


@dataclass(frozen=True)
class TrackerRow:
    """Metrics of one tracker on one recording; NaN where unknown. `tracked_share`: of the frames, with a
    pose. `max_cm`: largest position error."""

    recording: str
    tracker: str
    frames: int
    tracked_share: float
    ate_cm: float
    max_cm: float
    rpe_1s_cm: float
    rpe_1s_deg: float
    cpu_ms: float = math.nan
    cpu_mean_ms: float = math.nan
    cpu_p99_ms: float = math.nan


@dataclass(frozen=True)
class TrackerEntry:
    """A tracker to compare. `key`: in file names. `title`: for readers. `identity`: plain data that
    identifies it.

    `run(source, log, show)`: run it with a file for its log; `show` gets the number of frames done.
    """

    key: str
    title: str
    identity: Mapping[str, Any]
    can_run: Callable[[Source], bool]
    run: Callable[[Source, Path, Callable[[int], None]], TrackerRun]


def tracker_entries(
    settings: Config, pythons: Mapping[str, Path], vocabulary: Path | None
) -> tuple[list[TrackerEntry], list[str]]:
    """Return SHARE's tracker, then the peers; and why a peer is left out, with what to do.

    `pythons`: interpreters by key of `PEERS`; this process's by default.
    """
    entries = [
        TrackerEntry(
            "share",
            f"SHARE {__version__}",
            {"settings": to_mapping(settings)},
            lambda source: True,
            lambda source, log, show: run_share(source, settings, show),
        )
    ]
    missing = []
    for key, peer in PEERS.items():
        python = pythons.get(key, Path(sys.executable))
        version = peer_version(peer, python)
        if version is None:
            missing.append(
                f"{peer.title}: {python} does not have it; {peer.install}, then --peer {key}=DIR/bin/python"
            )
        elif peer.needs_vocabulary and vocabulary is None:
            missing.append(f"{peer.title}: needs its authors' vocabulary: give --vocabulary ORBvoc.txt")
        else:
            options_given = {"vocabulary": str(vocabulary)} if peer.needs_vocabulary else {}
            options = [word for name, value in options_given.items() for word in (f"--{name}", value)]
            command = [str(python), str(peer.path), *options]
            entries.append(
                TrackerEntry(key, version, options_given, can_run_peers, partial(_run_peer, command))
            )
    return entries, missing


def _run_peer(command: list[str], source: Source, log: Path, show: Callable[[int], None]) -> TrackerRun:
    return run_peer(source, command, log, show)


def tracker_rows(
    name: str, source: Source, tracker: TrackerEntry, out: Path, show: Callable[[int], None]
) -> Iterator[TrackerRow]:
    """Yield the rows of one tracker on the recording called `name`; read from `out` if already there.

    Raises UsageError where the stored rows are of something else, DataError where the tracker fails.
    """
    stem = out / f"{name.replace('/', '-')}-{tracker.key}"
    file, made_by = stem.with_suffix(".json"), _provenance(source, tracker)
    if not file.exists():
        run = tracker.run(source, stem.with_suffix(".log"), show)
        new_rows = [score_tracker(name, tracker.title, source, run.trajectory, run.cpu_ms)]
        atomic_write(stem.with_suffix(".tum"), format_tum(run.trajectory))
        if run.final is not None:
            new_rows.append(score_tracker(name, tracker.title + _FINAL_SUFFIX, source, run.final, []))
            atomic_write(stem.with_name(f"{stem.name}-final.tum"), format_tum(run.final))
        document = {
            "made_by": made_by,
            "machine": describe_machine(),
            "rows": [nan_to_none(dataclasses.asdict(row)) for row in new_rows],
        }
        atomic_write(file, json.dumps(document, indent=2) + "\n")
    stored: dict[str, Any] = read_json(file)
    if stored.get("made_by") != made_by:
        raise UsageError(f"{file}: is of another recording, version or setting; give another --out")
    try:
        for row in stored["rows"]:
            yield TrackerRow(**none_to_nan(row))
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{file}: is damaged: {error!r}; remove it") from None


def _provenance(source: Source, tracker: TrackerEntry) -> dict[str, Any]:
    """Return what the rows depend on, as it reads back from JSON."""
    provenance: dict[str, Any] = to_plain(
        {"recording": source.name, "tracker": tracker.title, **tracker.identity}
    )
    return provenance


def check_truth(name: str, source: Source) -> None:
    """Raise UsageError where the recording has no ground truth."""
    if source.truth() is None:
        raise UsageError(f"{name}: has no ground truth; trackers cannot be compared on it")


def score_tracker(
    name: str, tracker: str, source: Source, estimate: Trajectory, cpu_ms: Sequence[float]
) -> TrackerRow:
    """Return a row; errors are NaN where too few poses have a truth."""
    truth = source.truth()
    assert truth is not None  # see `check_truth`
    errors = (math.nan,) * 4
    try:
        absolute, relative = ate(estimate, truth), rpe_time(estimate, truth)
        rotation_deg = math.degrees(relative.rotation.rmse)
        errors = (100 * absolute.rmse, 100 * absolute.max, 100 * relative.translation.rmse, rotation_deg)
    except DataError:
        pass
    cpu = (
        [float(np.median(cpu_ms)), float(np.mean(cpu_ms)), float(np.percentile(cpu_ms, 99))] if cpu_ms else []
    )
    count = source.images_count
    return TrackerRow(name, tracker, count, len(estimate.stamps_ns) / max(count, 1), *errors, *cpu)


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
    cm = [format_number(value, ".2f") for value in (row.ate_cm, row.max_cm, row.rpe_1s_cm, row.rpe_1s_deg)]
    cpu = [format_number(value, ".1f") for value in (row.cpu_ms, row.cpu_mean_ms, row.cpu_p99_ms)]
    return [row.recording, row.tracker, *cm, f"{100 * row.tracked_share:.1f}", *cpu]


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
    draw_bars(folder / "cpu.png", {"mean CPU per frame": causal}, recordings, "ms", names=trackers)
    errors = image_link("Errors of each tracker", "errors.png")
    cpu = image_link("CPU time of each tracker", "cpu.png")
    return f"{errors}\n\n{cpu}\n"
