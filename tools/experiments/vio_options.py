"""Options of the tools that run over sequences x seeds."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from vio_sequences import SEQUENCES, Sequence

from share.errors import UsageError

ROOT = Path(__file__).resolve().parents[2]
_DATA = ROOT.parent / "shared" / "data" / "motion"


def parser(doc: str | None, out: str, seeds: tuple[int, ...]) -> argparse.ArgumentParser:
    """Return a parser. out: name of the folder in build/; seeds: the default."""
    made = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawTextHelpFormatter)
    names = [sequence.name for sequence in SEQUENCES]
    made.add_argument("--only", action="append", choices=names, help="may be repeated")
    made.add_argument("--seeds", type=_seeds, default=seeds, metavar="N,N,…")
    made.add_argument("--data", type=_folder, default=_DATA, help="recordings: euroc/NAME, tumvi/NAME")
    made.add_argument("--cache", type=Path, help="of sessions (default: the user's)")
    made.add_argument("--out", type=Path, default=ROOT / "build" / out)
    made.add_argument("--workers", type=int, default=2, help="processes that make sessions")
    made.add_argument("--again", action="store_true", help="repeat runs that exist")
    return made


def chosen(options: argparse.Namespace) -> list[Sequence]:
    """Return the chosen sequences with recordings; report the others. Raises UsageError without any."""
    found = list(_there(options))
    if not found:
        raise UsageError("none of the recordings exists; give their folder by --data")
    return found


def _there(options: argparse.Namespace) -> Iterator[Sequence]:
    for sequence in SEQUENCES:
        if options.only and sequence.name not in options.only:
            continue
        folder = sequence.recording(options.data)
        if folder is None or folder.exists():
            yield sequence
        else:
            print(f"left out: {sequence.name}, {folder} does not exist", file=sys.stderr)


def _folder(text: str) -> Path:
    return Path(text).resolve()


def _seeds(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a list of numbers such as 101,102") from None
