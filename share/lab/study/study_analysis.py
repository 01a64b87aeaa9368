"""All statistics of a study: each measure, each pair of conditions, order effects, preferences.

Rules for missing values: descriptive figures are of all values there are. Tests of a measure are of the
participants who have it in every condition (complete cases), also in pairs, so that all tests of a measure
are of the same people. The model of order effects takes every value whose place is known. Nothing is filled
in.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from share.errors import DataError
from share.lab.evaluate.statistics import Interval
from share.lab.study.observations import Observations
from share.lab.study.orders import Balance
from share.lab.study.power import NextStudy, next_study
from share.lab.study.rank_tests import (
    ChoiceTest,
    FriedmanTest,
    WilcoxonTest,
    choice_test,
    friedman,
    holm,
    nemenyi,
    wilcoxon,
)
from share.lab.study.repeated_anova import OrderEffects, RepeatedAnova, order_effects, repeated_anova
from share.lab.study.resampling import mean_interval
from share.types import F64

MIN_COMPLETE = 3  # participants, for a test
_DIGITS = 9  # decimals of a value; beyond, differences are of rounding


@dataclass(frozen=True)
class ConditionSummary:
    """One measure in one condition, over the `count` participants who have it. mean: with Student's 95 %."""

    condition: str
    count: int
    mean: Interval
    deviation: float
    least: float
    lower_quartile: float
    median: float
    upper_quartile: float
    greatest: float


@dataclass(frozen=True)
class ConditionPair:
    """Two conditions compared. difference: of the means, first less second, with Student's 95 %."""

    first: str
    second: str
    difference: Interval
    wilcoxon: WilcoxonTest
    p_holm: float
    p_nemenyi: float


@dataclass(frozen=True)
class MeasureAnalysis:
    """complete: participants with a value in every condition; below `MIN_COMPLETE` there are no tests."""

    name: str
    conditions: tuple[ConditionSummary, ...]
    complete: int
    friedman: FriedmanTest | None
    anova: RepeatedAnova | None
    pairs: tuple[ConditionPair, ...]
    order: OrderEffects | None
    next: NextStudy | None


@dataclass(frozen=True)
class StudyAnalysis:
    """balance: of the orders of participants who met all conditions; None without places."""

    participants: int
    conditions: tuple[str, ...]
    measures: tuple[MeasureAnalysis, ...]
    choices: dict[str, ChoiceTest]
    balance: Balance | None
    notes: tuple[str, ...]
    planned: int
    done: int


def analyse(table: Observations) -> StudyAnalysis:
    """Compute all statistics. Raises DataError where there is nothing to compute them of."""
    known = {name: values for name, values in table.measures.items() if np.isfinite(values).any()}
    if not known:
        raise DataError("no trial of this study was carried through yet: there is nothing to analyse")
    measures = tuple(_analyse_measure(name, values, table) for name, values in known.items())
    choices = {}
    for kind, named in table.choices.items():
        counts = Counter(one for one in named if one)
        choices[kind] = choice_test([counts[condition] for condition in table.conditions])
    empty = [name for name in table.measures if name not in known]
    notes = (*table.notes, *([f"without any value, and left out: {', '.join(empty)}"] if empty else []))
    return StudyAnalysis(
        len(table.participants),
        table.conditions,
        measures,
        choices,
        _balance(table),
        notes,
        table.planned,
        table.done,
    )


def _balance(table: Observations) -> Balance | None:
    places = table.places[(np.sort(table.places) == np.arange(1, len(table.conditions) + 1)).all(axis=1)]
    return Balance.of(np.argsort(places, axis=1)) if len(places) else None


def _analyse_measure(name: str, values: F64, table: Observations) -> MeasureAnalysis:
    names, values = table.conditions, values.round(_DIGITS)
    summaries = tuple(_summary(one, column) for one, column in zip(names, values.T, strict=True))
    whole = values[np.isfinite(values).all(axis=1)]
    if len(whole) < MIN_COMPLETE:
        return MeasureAnalysis(name, summaries, len(whole), None, None, (), None, None)
    ranks, anova = friedman(whole), repeated_anova(whole)
    order = order_effects(values, table.places) if (table.places > 0).any() else None
    pairs = () if math.isnan(ranks.chi2) else _pairs(whole, names, ranks)
    return MeasureAnalysis(name, summaries, len(whole), ranks, anova, pairs, order, next_study(whole, anova))


def _summary(condition: str, column: F64) -> ConditionSummary:
    known = column[np.isfinite(column)]
    mean = mean_interval(known)
    if not len(known):
        return ConditionSummary(condition, 0, mean, *[math.nan] * 6)
    deviation = float(known.std(ddof=1)) if len(known) > 1 else math.nan
    least, lower, median, upper, greatest = np.quantile(known, [0, 0.25, 0.5, 0.75, 1]).tolist()
    return ConditionSummary(condition, len(known), mean, deviation, least, lower, median, upper, greatest)


def _pairs(whole: F64, names: tuple[str, ...], ranks: FriedmanTest) -> tuple[ConditionPair, ...]:
    numbers = list(combinations(range(len(names)), 2))
    tests = [wilcoxon(whole[:, a], whole[:, b]) for a, b in numbers]
    adjusted = holm([one.p for one in tests])
    by_ranks = nemenyi(ranks.mean_ranks, len(whole))
    return tuple(
        ConditionPair(names[a], names[b], mean_interval(whole[:, a] - whole[:, b]), test, p, p_nemenyi)
        for (a, b), test, p, p_nemenyi in zip(numbers, tests, adjusted, by_ranks, strict=True)
    )
