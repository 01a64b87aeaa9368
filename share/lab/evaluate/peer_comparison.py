"""Our tracker and those of others on the same recordings: a row of figures each, kept as it comes."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from share import __version__
from share.config import Config
from share.errors import DataError, UsageError
from share.files.json_file import nan_to_none, none_to_nan, read_json, to_plain
from share.files.writing import atomic_write
from share.lab.evaluate.tracker_runs import TrackerRun, can_run_peers, peer_version, run_peer, run_share
from share.lab.peer_trackers import PEERS
from share.metrics.ate import ate
from share.metrics.rpe import rpe_time
from share.plain_data import to_mapping
from share.recordings.trajectory import Trajectory, format_tum
from share.runtime.machine import describe_machine
from share.runtime.source import Source

_FINAL_SUFFIX = ", in the end"


@dataclass(frozen=True)
class TrackerRow:
    """One tracker on one recording. told: share of the frames that have a pose. NaN: not known."""

    recording: str
    tracker: str
    frames: int
    told: float
    ate_cm: float
    most_cm: float
    rpe_1s_cm: float
    rpe_1s_deg: float
    cpu_ms: float = math.nan
    cpu_mean_ms: float = math.nan
    cpu_p99_ms: float = math.nan


@dataclass(frozen=True)
class TrackerEntry:
    """key: in names of files. title: for a reader. about: plain data that says which one it is. fits: whether
    it can be run on a recording. run: given one, a file for what else it says, and whom to tell how many
    frames are done."""

    key: str
    title: str
    identity: Mapping[str, Any]
    can_run: Callable[[Source], bool]
    run: Callable[[Source, Path, Callable[[int], None]], TrackerRun]


def tracker_entries(
    settings: Config, pythons: Mapping[str, Path], vocabulary: Path | None
) -> tuple[list[TrackerEntry], list[str]]:
    """Ours first; and why a peer is left out, with what to do. pythons: interpreters, by name of `PEERS`; by
    default, the one that runs this."""
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
            missing.append(f"{peer.title}: needs the vocabulary of its authors: --vocabulary ORBvoc.txt")
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
    name: str, source: Source, contender: TrackerEntry, out: Path, show: Callable[[int], None]
) -> Iterator[TrackerRow]:
    """Of one contender on the recording that is called `name`; from `out`, if they are there. Raises
    UsageError where they are there and of something else, DataError where it fails."""
    stem = out / f"{name.replace('/', '-')}-{contender.key}"
    file, made_by = stem.with_suffix(".json"), _provenance(source, contender)
    if not file.exists():
        run = contender.run(source, stem.with_suffix(".log"), show)
        new_rows = [score_tracker(name, contender.title, source, run.trajectory, run.cpu_ms)]
        atomic_write(stem.with_suffix(".tum"), format_tum(run.trajectory))
        if run.final is not None:
            new_rows.append(score_tracker(name, contender.title + _FINAL_SUFFIX, source, run.final, []))
            atomic_write(stem.with_name(f"{stem.name}-end.tum"), format_tum(run.final))
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


def _provenance(source: Source, contender: TrackerEntry) -> dict[str, Any]:
    """As it comes back from JSON."""
    provenance: dict[str, Any] = to_plain(
        {"recording": source.name, "tracker": contender.title, **contender.identity}
    )
    return provenance


def check_truth(name: str, source: Source) -> None:
    """Raises UsageError without a truth."""
    if source.truth() is None:
        raise UsageError(f"{name}: comes without a truth, so nobody can be told from another")


def score_tracker(
    name: str, tracker: str, source: Source, estimate: Trajectory, cpu_ms: Sequence[float]
) -> TrackerRow:
    """NaN where there are too few poses with a truth to speak of any."""
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
