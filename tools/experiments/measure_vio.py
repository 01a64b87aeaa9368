"""Accuracy of the inertial tracker: emulated sequences x seeds. Prints a Markdown table.

    python tools/experiments/measure_vio.py [--only NAME] [--seeds 101,102,103] [--seconds 60] [--hz 30]
        [--data FOLDER] [--again]

Causal poses of every frame. Sessions are made once (minutes each) and kept in the cache; a run by the same
code is not repeated. In --out: a JSON and the series of each run, table.md, a PNG a sequence.
CPU is process time of one thread without decoding; all other figures are deterministic.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from share import startup

startup.prepare_process()

import numpy as np  # noqa: E402
from tool_main import exit_code, line  # noqa: E402
from vio_picture import Curves, draw  # noqa: E402
from vio_run import figures, follow, series  # noqa: E402
from vio_sequences import Sequence, chosen_sequences, code_version, keep, kept  # noqa: E402
from vio_sequences import parser as sequences_parser  # noqa: E402

from share.config import Config  # noqa: E402
from share.files.writing import atomic_write  # noqa: E402
from share.lab.emulate.session import make_cached_session  # noqa: E402
from share.runtime.source import open_source  # noqa: E402

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
    _Column("with a pose %", "with_pose", ".1f", 100, min),
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


def main() -> int:
    options = arguments()
    return exit_code("measure_vio", lambda: measure(options))


def arguments() -> argparse.Namespace:
    return sequences_parser(__doc__, "vio", (101, 102, 103)).parse_args()


def measure(options: argparse.Namespace) -> None:
    """Do all runs, seed by seed; then the table and the pictures."""
    code, chosen = code_version(), chosen_sequences(options)
    rows = [run(sequence, seed, options, code) for seed in options.seeds for sequence in chosen]
    rows.sort(key=lambda row: [s.name for s in chosen].index(row["sequence"]))
    text = table(rows)
    print(text)
    atomic_write(options.out / "table.md", text + "\n")
    for sequence in chosen:
        picture(sequence, [row for row in rows if row["sequence"] == sequence.name], options)


def run(sequence: Sequence, seed: int, options: argparse.Namespace, code: str) -> Row:
    """Return a run's figures from its JSON if that is of this code and session, else do the run and keep
    it."""
    recipe = sequence.recipe(seed, options)
    made_by = {"sequence": sequence.name, "seed": seed, "code": code, "session": recipe.digest}
    file = _file(options.out, sequence.name, seed)
    if not options.again and (known := kept(file, made_by)) is not None:
        return known
    source = open_source(str(make_cached_session(recipe, options.cache, options.workers) / "agent"))
    tracked = follow(source, Config())
    found = series(source, tracked)
    row: Row = made_by | figures(source, tracked, found)
    options.out.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        file.with_suffix(".npz"),
        t_s=(found.stamps_ns - tracked.log.frames().stamp_ns[0]) * 1e-9,
        errors=found.deviations.errors,
        sigmas=found.deviations.sigmas,
        segment=found.segment,
    )
    keep(file, row)
    print(f"{sequence.name} {seed}: {_cm(row)}", file=sys.stderr, flush=True)
    return row


def picture(sequence: Sequence, rows: list[Row], options: argparse.Namespace) -> None:
    """Draw the runs of one sequence."""
    runs = []
    for row in rows:
        with np.load(_file(options.out, sequence.name, row["seed"]).with_suffix(".npz")) as curves:
            runs.append(Curves(f"seed {row['seed']}: ATE {_cm(row)}", **curves))
    what = f"{sequence.motion.rstrip(':')} in {sequence.scene}, {sequence.profile}, {options.seconds:g} s"
    draw(options.out / f"{sequence.name}.png", f"{sequence.name}: {what}", runs)


def _file(out: Path, name: str, seed: int) -> Path:
    return out / f"{name}-{seed}.json"


def _cm(row: Row) -> str:
    return "none" if row["ate_cm"] is None else f"{row['ate_cm']:.2f} cm"


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


if __name__ == "__main__":
    sys.exit(main())
