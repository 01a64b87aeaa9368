"""The report of a study: HTML and Markdown to read, CSV for programs, LaTeX for papers, figures."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

from share.files.writing import atomic_write
from share.lab.evaluate.report import bullets, html_page, image_link
from share.lab.study.observations import Observations
from share.lab.study.plan import SuccessRule
from share.lab.study.repeated_anova import PartialF
from share.lab.study.study_analysis import MeasureAnalysis, StudyAnalysis
from share.lab.study.study_figures import draw_choices, draw_measures
from share.lab.study.study_tables import (
    Rows,
    choice_rows,
    comparison_rows,
    coverage_lines,
    descriptive_rows,
    order_rows,
    pair_rows,
    power_rows,
    rule_line,
)
from share.lab.tables import csv_text, latex_tabular, latex_text, markdown_table

FILES = ("report.html", "report.md", "descriptives.csv", "tests.csv", "pairs.csv", "tables.tex")
METHODS = (
    "descriptive figures are of all values there are; 95 % intervals of means and of their differences are "
    "by Student's t, over participants",
    "all tests of a measure are of the participants who have it in every condition, whose number is given; "
    "nothing is filled in",
    "Friedman's chi-squared is corrected for ties; W is Kendall's",
    "with Mauchly's p below 0.05, read the ANOVA's p with Greenhouse and Geisser's epsilon (GG); with an "
    "epsilon above 0.75, Huynh and Feldt's (HF) is less strict",
    "Wilcoxon's signed-rank test is two-sided; differences of zero take ranks, which are then left out "
    "(Pratt); p is exact over all signs, ties included, up to 50 pairs that differ, beyond by the normal "
    "approximation; Holm adjusts it over the pairs of a measure, not over measures",
    "r is the rank-biserial correlation of the pairs that differ (Kerby), above 0 where the first is greater",
    "intervals of W, of r and of generalised eta squared are bias-corrected percentiles (Efron's BC) of 4000 "
    "samples of participants (fewer beyond 250 of them), drawn with replacement; W and eta squared cannot "
    "fall below 0, so theirs lie too high where there is no effect; the interval of partial eta squared is "
    "by the noncentral F, as if spherical",
    "effects of place and of the condition just before (carry-over) are partial F of the model value = "
    "participant + condition + place + condition before; the slope is of values less their condition's "
    "mean, a place, over each participant",
    "preferences are tested against the same chance for each condition; the exact p is of a chi-squared at "
    "least as large",
)
_POWER_NOTE = (
    "With the effect as found here, which a next study may not find. ANOVA: by the noncentral F, with the "
    "unbiased estimate of its noncentrality; Friedman: by 2000 samples of these participants, whose effect "
    "is on average too large. Plan with a lesser effect."
)


def write_report(
    study: StudyAnalysis, table: Observations, rule: SuccessRule | None, out: Path
) -> list[Path]:
    """Write the report to a folder; return its files. rule: of success, where goals were judged by one."""
    pictures = [image_link("Means with 95 % intervals; a dot is a participant", "study.png")]
    draw_measures(out / "study.png", study, table)
    (out / "preferences.png").unlink(missing_ok=True)  # of an earlier report
    if study.choices:
        draw_choices(out / "preferences.png", study)
        pictures.append(image_link("Preferences", "preferences.png"))
    text = "\n\n".join(_sections(study, pictures, rule)) + "\n"
    atomic_write(out / "descriptives.csv", _descriptives_csv(study))
    atomic_write(out / "tests.csv", _tests_csv(study))
    atomic_write(out / "pairs.csv", _pairs_csv(study))
    atomic_write(out / "tables.tex", _latex(study))
    atomic_write(out / "report.md", text)
    # html_page escapes HTML itself, and its Markdown does not know these two
    atomic_write(out / "report.html", html_page("Study", re.sub(r"\\([<>])", r"\1", text), out))
    return [out / name for name in FILES]


def _sections(study: StudyAnalysis, pictures: Sequence[str], rule: SuccessRule | None) -> list[str]:
    about = [*coverage_lines(study), *([] if rule is None else [rule_line(rule)])]
    parts = ["# Study", bullets(map(_markdown_text, about)), *pictures]
    for title, rows, note in (
        ("Descriptive figures", descriptive_rows(study), ""),
        ("Do the conditions differ?", comparison_rows(study), ""),
        ("Which differ?", pair_rows(study), ""),
        ("Order and learning", order_rows(study), ""),
        ("Preferences", choice_rows(study), ""),
        ("The next study", power_rows(study), _POWER_NOTE),
    ):
        if len(rows) > 1:
            cells = [[_markdown_text(cell) for cell in row] for row in rows]
            parts += [f"## {title}", *([note] if note else []), markdown_table(cells)]
    return [*parts, "## How it was computed", bullets(METHODS)]


_MARKDOWN = re.compile(r"[\\`*_\[\]!|#~]|<(?=[A-Za-z/!?])|^(?:>|[-+](?= ))|(?<=^\d)[.)]|(?<=^\d\d)[.)]")


def _markdown_text(text: str) -> str:
    """Return text that Markdown shows as it is: names of files must not become links or pictures."""
    return _MARKDOWN.sub(lambda found: f"\\{found[0]}", " ".join(text.split()))


# CSV: numbers alone, an empty cell where there is none.


def _csv_name(name: str) -> str:
    """Return a name that no spreadsheet takes for a formula."""
    return f"'{name}" if name.startswith(("=", "+", "-", "@")) else name


def _bounds(name: str) -> tuple[str, str, str]:
    return name, f"{name} low", f"{name} high"


def _descriptives_csv(study: StudyAnalysis) -> str:
    head = [*("measure", "condition", "n"), *_bounds("mean"), *("SD", "min", "q1", "median", "q3", "max")]
    rows = [
        [
            *(_csv_name(measure.name), _csv_name(one.condition), one.count, *one.mean, one.deviation),
            *(one.least, one.lower_quartile, one.median, one.upper_quartile, one.greatest),
        ]
        for measure in study.measures
        for one in measure.conditions
    ]
    return csv_text(head, rows)


_TESTS_HEAD = (
    *("measure", "n", "Friedman chi2", "Friedman df", "Friedman p", *_bounds("W")),
    *("F", "df", "df error", "p", "p GG", "p HF", "Mauchly W", "Mauchly chi2", "Mauchly p"),
    *("epsilon GG", "epsilon HF", *_bounds("partial eta2"), *_bounds("generalised eta2")),
    *(f"{effect} {name}" for effect in ("place", "carry-over") for name in ("F", "df", "df error", "p")),
    *_bounds("slope a place"),
)


def _tests_csv(study: StudyAnalysis) -> str:
    return csv_text(_TESTS_HEAD, (_test_cells(one) for one in study.measures))


def _test_cells(one: MeasureAnalysis) -> list[object]:
    cells: list[object] = [_csv_name(one.name), one.complete]
    if one.friedman is not None and one.anova is not None:
        ranks, anova, sphericity = one.friedman, one.anova, one.anova.sphericity
        cells += [ranks.chi2, ranks.df, ranks.p, *ranks.concordance]
        cells += [anova.f, anova.df, anova.df_error, anova.p, anova.p_gg, anova.p_hf]
        cells += [sphericity.w, sphericity.chi2, sphericity.p]
        cells += [sphericity.greenhouse_geisser, sphericity.huynh_feldt]
        cells += [*anova.partial_eta2, *anova.generalised_eta2]
    else:
        cells += [math.nan] * 23
    if one.order is not None:
        cells += [*_partial_cells(one.order.place), *_partial_cells(one.order.carry_over), *one.order.slope]
    else:
        cells += [math.nan] * 11
    return cells


def _partial_cells(one: PartialF) -> tuple[float, ...]:
    return one.f, one.df, one.df_error, one.p


def _pairs_csv(study: StudyAnalysis) -> str:
    head = [
        *("measure", "first", "second", *_bounds("difference"), "Wilcoxon W", "differ", "n", "p", "exact"),
        *("p Holm", "p Nemenyi", *_bounds("r")),
    ]
    rows = [
        [
            *(*map(_csv_name, (measure.name, one.first, one.second)), *one.difference),
            *(one.wilcoxon.w, one.wilcoxon.pairs, one.wilcoxon.total_pairs),
            *(one.wilcoxon.p, int(one.wilcoxon.is_exact), one.p_holm, one.p_nemenyi),
            *one.wilcoxon.rank_biserial,
        ]
        for measure in study.measures
        for one in measure.pairs
    ]
    return csv_text(head, rows)


# LaTeX.


def _latex(study: StudyAnalysis) -> str:
    tables = {
        "Descriptive figures": descriptive_rows(study),
        "Friedman's test and repeated-measures ANOVA": comparison_rows(study),
        "Pairs of conditions": pair_rows(study),
    }
    return "\n\n".join(latex_table(rows, caption) for caption, rows in tables.items()) + "\n"


def latex_table(rows: Rows, caption: str) -> str:
    """Return a LaTeX table of rows with their head."""
    lines = [r"\begin{table}", rf"\caption{{{latex_text(caption)}}}", latex_tabular(rows), r"\end{table}"]
    return "\n".join(lines)
