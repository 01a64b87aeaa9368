"""Tables as text: CSV for a program, Markdown for a reader; what is not known is empty, or a dash."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence


def csv_text(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Numbers to six digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    for row in rows:
        writer.writerow([_cell(value) for value in row])
    return text.getvalue()


def _cell(value: object) -> object:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return value


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """The first of `rows` is its head."""
    head, *body = rows
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *body))


def bullets(texts: Iterable[str]) -> str:
    """A Markdown list of sentences."""
    return "\n".join(f"* {text[0].upper()}{text[1:]}." for text in texts)


def picture(said: str, name: str) -> str:
    """Of Markdown, a paragraph of its own. name: of a file beside it."""
    return f"![{said}]({name})"


def number(value: float, form: str = ".3g") -> str:
    return "–" if math.isnan(value) else format(value, form)
