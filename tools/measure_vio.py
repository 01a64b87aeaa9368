"""What the inertial tracker is worth over 60 s: emulated sequences x seeds. Prints a Markdown table.

    python tools/measure_vio.py [--only NAME] [--seeds 101,102,103] [--data FOLDER] [--again]

Causal poses of every frame. Sessions are made once (minutes each) and kept in the cache; a run that was
made by the same code is not done again. In --out: a JSON and the series of each run, table.md; in
--pictures: a PNG a sequence.
CPU is process time of one thread, decoding apart; all other figures are the same every time.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path

from share import process

process.prepare()

import numpy as np  # noqa: E402
from vio_picture import Curves, draw  # noqa: E402
from vio_run import figures, follow, series  # noqa: E402
from vio_sequences import SECONDS, SEQUENCES, Sequence  # noqa: E402
from vio_table import Row, table  # noqa: E402

import share  # noqa: E402
from share.config import Config  # noqa: E402
from share.emulate.session import cached_session  # noqa: E402
from share.errors import ShareError, UsageError  # noqa: E402
from share.io.files import atomic_write  # noqa: E402
from share.io.source import open_source  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data" / "motion"
NOT_IN_A_RUN = ("cli", "emulate", "merge", "mocap", "wire")  # of share/


def main() -> int:
    options = arguments()
    try:
        measure(options)
    except ShareError as error:
        print(f"measure_vio: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    names = [sequence.name for sequence in SEQUENCES]
    parser.add_argument("--only", action="append", choices=names, help="may be repeated")
    parser.add_argument("--seeds", type=_seeds, default=(101, 102, 103), metavar="N,N,…")
    parser.add_argument("--data", type=Path, default=DATA, help="recordings: euroc/NAME, tumvi/NAME")
    parser.add_argument("--cache", type=Path, help="of sessions (default: the user's)")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "vio")
    parser.add_argument("--pictures", type=Path, default=ROOT / "docs" / "pictures" / "vio")
    parser.add_argument("--workers", type=int, default=2, help="processes that make sessions")
    parser.add_argument("--again", action="store_true", help="also what this code has run already")
    return parser.parse_args()


def measure(options: argparse.Namespace) -> None:
    """All runs, seed by seed; then the table and the pictures."""
    options.data, code = options.data.resolve(), code_version()
    chosen = list(there(options))
    if not chosen:
        raise UsageError("none of the recordings asked for is there; say where they are with --data")
    rows = [run(sequence, seed, options, code) for seed in options.seeds for sequence in chosen]
    rows.sort(key=lambda row: [s.name for s in chosen].index(row["sequence"]))
    text = table(rows)
    print(text)
    atomic_write(options.out / "table.md", text + "\n")
    for sequence in chosen:
        picture(sequence, [row for row in rows if row["sequence"] == sequence.name], options)


def there(options: argparse.Namespace) -> Iterator[Sequence]:
    """The sequences asked for whose recordings are there; the others are named."""
    for sequence in SEQUENCES:
        if options.only and sequence.name not in options.only:
            continue
        folder = sequence.recording(options.data)
        if folder is None or folder.exists():
            yield sequence
        else:
            print(f"left out: {sequence.name}, {folder} is not there", file=sys.stderr)


def run(sequence: Sequence, seed: int, options: argparse.Namespace, code: str) -> Row:
    """From its JSON, if that is of this code and session; else done, and kept there."""
    recipe = sequence.recipe(seed, options.data)
    made_by = {"sequence": sequence.name, "seed": seed, "code": code, "session": recipe.digest}
    file = _file(options.out, sequence.name, seed)
    if file.exists() and not options.again:
        row: Row = json.loads(file.read_text())
        if {key: row[key] for key in made_by} == made_by:
            return row
    source = open_source(str(cached_session(recipe, options.cache, options.workers) / "agent"))
    told = follow(source, Config())
    found = series(source, told)
    row = made_by | figures(source, told, found)
    options.out.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        file.with_suffix(".npz"),
        t_s=(found.stamps_ns - told.log.rows[0].stamp_ns) * 1e-9,
        errors=found.deviations.errors,
        sigmas=found.deviations.sigmas,
        stretch=found.stretch,
    )
    atomic_write(file, json.dumps(row, indent=2) + "\n")
    print(f"{sequence.name} {seed}: {_cm(row)}", file=sys.stderr, flush=True)
    return row


def picture(sequence: Sequence, rows: list[Row], options: argparse.Namespace) -> None:
    """Of the runs of one sequence."""
    runs = []
    for row in rows:
        with np.load(_file(options.out, sequence.name, row["seed"]).with_suffix(".npz")) as kept:
            runs.append(Curves(f"seed {row['seed']}: ATE {_cm(row)}", **kept))
    what = f"{sequence.motion.rstrip(':')} in {sequence.scene}, {sequence.profile}, {SECONDS:g} s"
    draw(options.pictures / f"{sequence.name}.png", f"{sequence.name}: {what}", runs)


def code_version() -> str:
    """Differs where anything does that a run goes through."""
    digest = hashlib.sha256()
    package = Path(share.__file__).parent
    files = [p for p in package.rglob("*.py") if p.relative_to(package).parts[0] not in NOT_IN_A_RUN]
    for path in sorted(files) + sorted(Path(__file__).parent.glob("vio_run.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _file(out: Path, name: str, seed: int) -> Path:
    return out / f"{name}-{seed}.json"


def _cm(row: Row) -> str:
    return "none" if row["ate_cm"] is None else f"{row['ate_cm']:.2f} cm"


def _seeds(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a list of numbers such as 101,102") from None


if __name__ == "__main__":
    sys.exit(main())
