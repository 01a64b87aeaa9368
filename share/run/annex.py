"""What else a report may hold, by who made it: settings that were tried, models of the error compared."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from share.errors import UsageError
from share.train.score import read_scores, table

SWEEP, HEAT = "sweep.md", "heat.png"


@dataclass(frozen=True)
class Annex:
    """text: Markdown with a heading. pictures: PNG files by what is below each."""

    text: str
    pictures: dict[str, Path]


def annex(path: Path) -> Annex:
    """Of a folder by `share evaluate sweep`, or a file by `share train compare --json`. Raises UsageError for
    anything else, DataError for a damaged one."""
    if path.is_file():
        return Annex(f"## Models of the error\n\n{table(read_scores(path))}\n", {})
    if not (path / SWEEP).is_file():
        raise UsageError(
            f"--with {path}: give a folder by `share evaluate sweep`, "
            f"or a file by `share train compare --json`"
        )
    heat = path / HEAT
    pictures = {f"Settings tried: {path.name}": heat} if heat.is_file() else {}
    return Annex(f"## Settings tried: {path.name}\n\n{(path / SWEEP).read_text()}", pictures)
