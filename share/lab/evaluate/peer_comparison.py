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
from share.files.json_file import known, plain, read_json, with_nan
from share.files.writing import atomic_write
from share.lab.evaluate.peers import TrackerRun, fits, ours, theirs, version_of
from share.lab.peers import PEERS
from share.metrics.ate import ate
from share.metrics.rpe import rpe_time
from share.plain_data import to_mapping
from share.recordings.trajectory import Trajectory, format_tum
from share.runtime.machine import describe_machine
from share.runtime.source import Source

_END = ", in the end"


@dataclass(frozen=True)
class Row:
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
class Contender:
    """key: in names of files. title: for a reader. about: plain data that says which one it is. fits: whether
    it can be run on a recording. run: given one, a file for what else it says, and whom to tell how many
    frames are done."""

    key: str
    title: str
    about: Mapping[str, Any]
    fits: Callable[[Source], bool]
    run: Callable[[Source, Path, Callable[[int], None]], TrackerRun]


def contenders(
    settings: Config, pythons: Mapping[str, Path], vocabulary: Path | None
) -> tuple[list[Contender], list[str]]:
    """Ours first; and why a peer is left out, with what to do. pythons: interpreters, by name of `PEERS`; by
    default, the one that runs this."""
    found = [
        Contender(
            "share",
            f"SHARE {__version__}",
            {"settings": to_mapping(settings)},
            lambda source: True,
            lambda source, log, show: ours(source, settings, show),
        )
    ]
    lacking = []
    for key, peer in PEERS.items():
        python = pythons.get(key, Path(sys.executable))
        version = version_of(peer, python)
        if version is None:
            lacking.append(
                f"{peer.title}: {python} does not have it; {peer.install}, then --peer {key}=DIR/bin/python"
            )
        elif peer.vocabulary and vocabulary is None:
            lacking.append(f"{peer.title}: needs the vocabulary of its authors: --vocabulary ORBvoc.txt")
        else:
            given = {"vocabulary": str(vocabulary)} if peer.vocabulary else {}
            options = [word for name, value in given.items() for word in (f"--{name}", value)]
            command = [str(python), str(peer.path), *options]
            found.append(Contender(key, version, given, fits, partial(_theirs, command)))
    return found, lacking


def _theirs(command: list[str], source: Source, log: Path, show: Callable[[int], None]) -> TrackerRun:
    return theirs(source, command, log, show)


def rows(
    name: str, source: Source, contender: Contender, out: Path, show: Callable[[int], None]
) -> Iterator[Row]:
    """Of one contender on the recording that is called `name`; from `out`, if they are there. Raises
    UsageError where they are there and of something else, DataError where it fails."""
    stem = out / f"{name.replace('/', '-')}-{contender.key}"
    file, made_by = stem.with_suffix(".json"), _made_by(source, contender)
    if not file.exists():
        run = contender.run(source, stem.with_suffix(".log"), show)
        found = [figures(name, contender.title, source, run.trajectory, run.cpu_ms)]
        atomic_write(stem.with_suffix(".tum"), format_tum(run.trajectory))
        if run.final is not None:
            found.append(figures(name, contender.title + _END, source, run.final, []))
            atomic_write(stem.with_name(f"{stem.name}-end.tum"), format_tum(run.final))
        told = {
            "made_by": made_by,
            "machine": describe_machine(),
            "rows": [known(dataclasses.asdict(row)) for row in found],
        }
        atomic_write(file, json.dumps(told, indent=2) + "\n")
    kept: dict[str, Any] = read_json(file)
    if kept.get("made_by") != made_by:
        raise UsageError(f"{file}: is of another recording, version or setting; give another --out")
    try:
        for row in kept["rows"]:
            yield Row(**with_nan(row))
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{file}: is damaged: {error!r}; remove it") from None


def _made_by(source: Source, contender: Contender) -> dict[str, Any]:
    """As it comes back from JSON."""
    told: dict[str, Any] = plain({"recording": source.name, "tracker": contender.title, **contender.about})
    return told


def check(name: str, source: Source) -> None:
    """Raises UsageError without a truth."""
    if source.truth() is None:
        raise UsageError(f"{name}: comes without a truth, so nobody can be told from another")


def figures(name: str, tracker: str, source: Source, estimate: Trajectory, cpu_ms: Sequence[float]) -> Row:
    """NaN where there are too few poses with a truth to speak of any."""
    truth = source.truth()
    assert truth is not None  # see `check`
    errors = (math.nan,) * 4
    try:
        absolute, relative = ate(estimate, truth), rpe_time(estimate, truth)
        turned = math.degrees(relative.rotation.rmse)
        errors = (100 * absolute.rmse, 100 * absolute.max, 100 * relative.translation.rmse, turned)
    except DataError:
        pass
    cpu = (
        [float(np.median(cpu_ms)), float(np.mean(cpu_ms)), float(np.percentile(cpu_ms, 99))] if cpu_ms else []
    )
    count = source.images_count
    return Row(name, tracker, count, len(estimate.stamps_ns) / max(count, 1), *errors, *cpu)
