"""What else a report may hold, by who made it: settings that were tried, models of the error compared."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from share.errors import DataError, UsageError
from share.io.regular_file import SETTINGS, read_text
from share.run.as_text import picture
from share.train.score import read_scores, table

SWEEP, HEAT = "sweep.md", "heat.png"


@dataclass(frozen=True)
class Annex:
    """text: Markdown with a heading. pictures: PNG files that it shows, by the names that it has for them."""

    text: str
    pictures: dict[str, Path]


def annex(path: Path, number: int) -> Annex:
    """Of a folder by `share evaluate sweep`, or a file by `share train compare --json`: a report's first or
    `number`th. Raises UsageError for anything else, DataError for a damaged one."""
    if path.is_file():
        return Annex(f"## Models of the error: {path.stem}\n\n{table(read_scores(path))}\n", {})
    if not (path / SWEEP).is_file():
        raise UsageError(
            f"--with {path}: give a folder by `share evaluate sweep`, "
            f"or a file by `share train compare --json`"
        )
    heat = path / HEAT
    text = f"## Settings tried: {path.name}\n\n{_text(path / SWEEP)}"
    if not heat.is_file():
        return Annex(text, {})
    name = f"heat-{number}.png"
    return Annex(f"{text}\n{picture('Means over the first two settings', name)}\n", {name: heat})


def _text(path: Path) -> str:
    try:
        return read_text(path, SETTINGS)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise DataError(f"{path}: cannot be read: {reason}") from None
