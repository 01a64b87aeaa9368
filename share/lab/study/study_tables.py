"""The statistics of a study as tables of text, for a terminal, Markdown and LaTeX."""

from __future__ import annotations

import math

from share.lab.evaluate.statistics import Interval
from share.lab.study.plan import SuccessRule
from share.lab.study.power import ALPHA, NextStudy
from share.lab.study.repeated_anova import PartialF
from share.lab.study.study_analysis import MIN_COMPLETE, StudyAnalysis
from share.lab.tables import format_number
from share.robot.settings import CREATE3_SPEED_M_S

_NOTHING = 1e-12  # below this a number is what rounding left
Rows = list[list[str]]  # the first is the head


def p_text(p: float) -> str:
    """Return a p value with three decimals."""
    return "–" if math.isnan(p) else "<0.001" if p < 0.001 else f"{p:.3f}"


def value_text(value: float, form: str = ".2f") -> str:
    """Return a number with fixed decimals, or with two digits where these would show another number as 0."""
    text = format_number(value, form)
    if math.isnan(value) or float(text) != 0:
        return text
    return text.lstrip("-") if abs(value) < _NOTHING else f"{value:.2g}"


def _interval_text(one: Interval, form: str = ".2f") -> str:
    if math.isnan(one.low):
        return value_text(one.value, form)
    value, low, high = (value_text(each, form) for each in (one.value, one.low, one.high))
    return f"{value} [{low}, {high}]"


def descriptive_rows(study: StudyAnalysis) -> Rows:
    """Return a table with its head: a row for each measure and condition."""
    rows = [["measure", "condition", "n", "mean [95 %]", "SD", "median", "quartiles", "range"]]
    for measure in study.measures:
        for one in measure.conditions:
            rows.append(
                [
                    *(measure.name, one.condition, str(one.count), _interval_text(one.mean)),
                    *(value_text(one.deviation), value_text(one.median)),
                    _span_text(one.lower_quartile, one.upper_quartile),
                    _span_text(one.least, one.greatest),
                ]
            )
    return rows


def _span_text(low: float, high: float) -> str:
    return "–" if math.isnan(low) else f"{value_text(low)} to {value_text(high)}"


def comparison_rows(study: StudyAnalysis) -> Rows:
    """Return Friedman and ANOVA of each measure."""
    head = [
        "measure",
        "n",
        "Friedman",
        "p",
        "W [95 %]",
        "ANOVA",
        "p",
        "p GG",
        "p HF",
        "Mauchly W",
        "p",
        "ε GG",
    ]
    rows = [[*head, "ε HF", "partial η² [95 %]", "generalised η² [95 %]"]]
    for one in study.measures:
        if one.friedman is None or one.anova is None:
            rows.append([one.name, str(one.complete), *["–"] * 13])
            continue
        ranks, anova, sphericity = one.friedman, one.anova, one.anova.sphericity
        rows.append(
            [
                *(one.name, str(one.complete), f"χ²({ranks.df}) = {format_number(ranks.chi2, '.2f')}"),
                *(p_text(ranks.p), _interval_text(ranks.concordance)),
                f"F({anova.df}, {anova.df_error}) = {format_number(anova.f, '.2f')}",
                *(p_text(p) for p in (anova.p, anova.p_gg, anova.p_hf)),
                *(format_number(sphericity.w, ".3f"), p_text(sphericity.p)),
                format_number(sphericity.greenhouse_geisser, ".3f"),
                format_number(sphericity.huynh_feldt, ".3f"),
                *(_interval_text(value, ".3f") for value in (anova.partial_eta2, anova.generalised_eta2)),
            ]
        )
    return rows


def pair_rows(study: StudyAnalysis) -> Rows:
    """Return every pair of conditions of each measure."""
    head = ["measure", "pair", "difference [95 %]", "Wilcoxon W", "differ", "p", "p Holm", "p Nemenyi"]
    rows = [[*head, "r [95 %]"]]
    for measure in study.measures:
        for one in measure.pairs:
            test = one.wilcoxon
            rows.append(
                [
                    *(measure.name, f"{one.first} – {one.second}", _interval_text(one.difference)),
                    *(f"{test.w:g}", f"{test.pairs} of {test.total_pairs}"),
                    p_text(test.p) + ("" if test.is_exact else " (normal)"),
                    *(p_text(one.p_holm), p_text(one.p_nemenyi), _interval_text(test.rank_biserial)),
                ]
            )
    return rows


def order_rows(study: StudyAnalysis) -> Rows:
    """Return effects of place and carry-over on each measure; the head alone where none is known."""
    rows = [["measure", "place", "p", "carry-over", "p", "slope a place [95 %]"]]
    for one in study.measures:
        if one.order is not None:
            place, carry = one.order.place, one.order.carry_over
            rows.append(
                [
                    *(one.name, _f_text(place), p_text(place.p), _f_text(carry), p_text(carry.p)),
                    _interval_text(one.order.slope, ".3f"),
                ]
            )
    return rows


def _f_text(one: PartialF) -> str:
    return f"F({one.df}, {one.df_error}) = {one.f:.2f}" if not math.isnan(one.f) else "–"


def choice_rows(study: StudyAnalysis) -> Rows:
    """Return the preferences; the head alone where there are none."""
    rows = [["", *study.conditions, "χ²", "p", "exact p"]]
    for kind, one in study.choices.items():
        counts = [str(count) for count in one.counts]
        statistic = f"χ²({one.df}) = {format_number(one.chi2, '.2f')}"
        rows.append([f"{kind} preferred", *counts, statistic, p_text(one.p), p_text(one.p_exact)])
    return rows


def power_rows(study: StudyAnalysis) -> Rows:
    """Return power by number of participants; the head alone where there is no F."""
    known = [(one.name, one.next) for one in study.measures if one.next is not None]
    if not known:
        return [["measure"]]
    rows = [["measure", "test", *map(str, known[0][1].sizes), "n for 80 %"]]
    for name, power in known:
        rows.append([name, "ANOVA", *(f"{p:.2f}" for p in power.anova), _needed_text(power)])
        rows.append([name, "Friedman", *(f"{p:.2f}" for p in power.friedman), ""])
    return rows


def _needed_text(power: NextStudy) -> str:
    needed, worst = (
        "over 500" if count is None else str(count) for count in (power.needed, power.needed_at_worst)
    )
    return f"{needed} ({worst} at the interval's lower end)"


def _incomplete_lines(study: StudyAnalysis) -> list[str]:
    """Say of which measures some participants are missing, or too few are there."""

    def said(complete: int) -> str:
        few = "" if complete >= MIN_COMPLETE else f": too few for tests, which want {MIN_COMPLETE}"
        return f"{complete} of {study.participants} participants are complete{few}"

    found = [
        (one.name, one.complete)
        for one in study.measures
        if one.complete < max(study.participants, MIN_COMPLETE)
    ]
    counts = {complete for _, complete in found}
    if len(found) == len(study.measures) > 1 and len(counts) == 1:
        return [f"all measures: {said(counts.pop())}"]
    return [f"{name}: {said(complete)}" for name, complete in found]


def coverage_lines(study: StudyAnalysis) -> list[str]:
    """Say how much of the study there is, how the orders were balanced, and what a reader must know."""
    people = f"{study.participants} participant{'s' * (study.participants != 1)}"
    lines = [f"{people}, conditions {', '.join(study.conditions)}"]
    if study.done < study.planned:
        lines.append(f"NOT THE WHOLE STUDY: {study.done} of {study.planned} trials")
    lines += _incomplete_lines(study)
    if study.balance is not None:
        lines += [f"orders as carried out: {line}" for line in study.balance.lines(list(study.conditions))]
    return [*lines, *study.notes]


def overview_rows(study: StudyAnalysis) -> Rows:
    """Return a row for each measure: its means and its main tests."""
    rows = [["measure", "n", *study.conditions, "Friedman", "p", "W", "ANOVA", "p GG"]]
    for one, tested in zip(study.measures, comparison_rows(study)[1:], strict=True):
        means = [value_text(condition.mean.value) for condition in one.conditions]
        _, count, chi2, p, w, f, _, p_gg, *_ = tested
        rows.append([one.name, count, *means, chi2, p, w, f, p_gg])
    return rows


def differing_rows(study: StudyAnalysis) -> Rows:
    """Return the pairs that differ by Holm's p."""
    head, *rows = pair_rows(study)
    pairs = [one for measure in study.measures for one in measure.pairs]
    return [head, *(row for row, one in zip(rows, pairs, strict=True) if one.p_holm < ALPHA)]


def rule_line(rule: SuccessRule) -> str:
    """Say when a goal is reached."""
    return (
        f"a goal is reached if the robot stands within {rule.distance_m:g} m of the cube within "
        f"{rule.timeout_s:g} s of the call; the longer time-out adds the way's length / "
        f"{CREATE3_SPEED_M_S} m/s"
    )
