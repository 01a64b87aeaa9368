"""Tables as text: CSV for programs, Markdown, LaTeX. Unknown values are empty in CSV, a dash elsewhere."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Sequence


def csv_text(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return CSV; floats with six digits, NaN as an empty cell."""
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


def format_number(value: float, form: str = ".3g") -> str:
    return "–" if math.isnan(value) else format(value, form)


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; the first of `rows` is its head."""
    head, *body = rows
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *body))


def latex_tabular(rows: Sequence[Sequence[str]]) -> str:
    """Return a LaTeX tabular; the first of `rows` is its head. It needs no package. A cell in ** is bold."""
    # {}: else \\ takes a [ or * of the next row for its own
    head, *body = ("{}" + " & ".join(map(_latex_cell, row)) + r" \\" for row in rows)
    columns = "l" + "r" * (len(rows[0]) - 1)
    start = (rf"\begin{{tabular}}{{{columns}}}", r"\hline", head, r"\hline")
    return "\n".join([*start, *body, r"\hline", r"\end{tabular}"])


def _latex_cell(cell: str) -> str:
    bold = re.fullmatch(r"\*\*(.+)\*\*", cell)
    return latex_text(cell) if bold is None else rf"\textbf{{{latex_text(bold[1])}}}"


_LATEX = {char: "\\" + char for char in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": "$<$",
    ">": "$>$",
    "χ": r"$\chi$",
    "²": "$^2$",
    "η": r"$\eta$",
    "ε": r"$\epsilon$",
    "–": "--",
}


def latex_text(text: str) -> str:
    """Return text with what LaTeX takes for its own escaped."""
    return "".join(_LATEX.get(char, char) for char in text)
