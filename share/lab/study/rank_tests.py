"""Tests by ranks of values (participants, conditions) without gaps: Friedman, Wilcoxon, Holm, Nemenyi.

Sources: M. Friedman, JASA 32, 1937; M. G. Kendall and B. Babington Smith, Annals of Mathematical Statistics
10, 1939; J. W. Pratt, JASA 54, 1959; S. Holm, Scandinavian Journal of Statistics 6, 1979; J. Demšar, JMLR 7,
2006 (Nemenyi); D. S. Kerby, Comprehensive Psychology 3, 2014 (rank-biserial correlation).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from share.lab.evaluate.statistics import Interval
from share.lab.study.resampling import bootstrap
from share.types import F64

EXACT_PAIRS = 50  # up to which Wilcoxon's p is exact; beyond, by the normal approximation
_TIE_DIGITS = 9  # decimals to which values are compared: 0.1 + 0.2 ties with 0.3


def average_ranks(values: F64) -> F64:
    """Return ranks from 1 of values (N,); ties share their mean rank."""
    _, group, counts = np.unique(values.round(_TIE_DIGITS), return_inverse=True, return_counts=True)
    last = counts.cumsum()
    ranks: F64 = (last - (counts - 1) / 2)[group.ravel()]
    return ranks


def _row_ranks(values: F64) -> F64:
    return np.array([average_ranks(row) for row in values])


@dataclass(frozen=True)
class FriedmanTest:
    """chi2: corrected for ties. concordance: Kendall's W, with a bootstrap interval over participants."""

    chi2: float
    df: int
    p: float
    concordance: Interval
    mean_ranks: tuple[float, ...]
    participants: int


def friedman(values: F64) -> FriedmanTest:
    """Test whether conditions differ; NaN where every participant gives all conditions the same value."""
    from scipy.special import chdtrc

    n, k = values.shape
    ranks = _row_ranks(values)
    ties = _tie_terms(ranks)

    def concordance(weights: F64) -> F64:
        sums = weights @ ranks
        spread = n**2 * k * (k**2 - 1) - n * weights @ ties
        with np.errstate(invalid="ignore", divide="ignore"):
            found = (12 * (sums**2).sum(axis=1) - 3 * n**2 * k * (k + 1) ** 2) / spread
        return np.where(spread > 0, found, math.nan)

    w = bootstrap(concordance, n)
    chi2 = n * (k - 1) * w.value
    return FriedmanTest(chi2, k - 1, float(chdtrc(k - 1, chi2)), w, tuple(ranks.mean(axis=0).tolist()), n)


def _tie_terms(ranks: F64) -> F64:
    """Return the sum of t³ - t over groups of t ties, for each row."""
    terms = []
    for row in ranks:
        counts = np.unique(row, return_counts=True)[1].astype(float)
        terms.append((counts**3 - counts).sum())
    return np.array(terms)


@dataclass(frozen=True)
class WilcoxonTest:
    """Two-sided signed-rank test. w: lesser sum of ranks. pairs: that differ, of all. rank_biserial: of
    these, positive where the first is greater, with a bootstrap interval over participants."""

    w: float
    p: float
    is_exact: bool
    pairs: int
    total_pairs: int
    rank_biserial: Interval


def wilcoxon(first: F64, second: F64, max_exact: int = EXACT_PAIRS) -> WilcoxonTest:
    """Test whether first - second (N,) is symmetric about 0. Zeros take ranks, which are then left out
    (Pratt). p: exact, over all signs of the ranks as they are, ties included, up to `max_exact` pairs."""
    differences = (first - second).round(_TIE_DIGITS)
    ranks = average_ranks(np.abs(differences))
    kept = differences != 0
    plus, minus = (float(ranks[sign].sum()) for sign in (differences > 0, differences < 0))
    is_exact = int(kept.sum()) <= max_exact
    p = _exact_p(ranks[kept], plus) if is_exact else _normal_p(ranks, kept, plus)
    return WilcoxonTest(
        min(plus, minus), p, is_exact, int(kept.sum()), len(differences), _rank_biserial(differences)
    )


def _exact_p(ranks: F64, plus: float) -> float:
    """Return the two-sided p of a sum of positive ranks, with each sign of each rank as likely."""
    doubled = np.rint(2 * ranks).astype(int)  # ranks of ties are halves
    chances = np.zeros(doubled.sum() + 1)
    chances[0], reach = 1.0, 0
    for rank in doubled.tolist():
        chances[rank : reach + rank + 1] += chances[: reach + 1].copy()
        chances /= 2
        reach += rank
    at = round(2 * plus)
    return float(min(1.0, 2 * min(chances[: at + 1].sum(), chances[at:].sum())))


def _normal_p(ranks: F64, kept: np.ndarray, plus: float) -> float:
    """Return the two-sided p by the normal approximation, without continuity correction."""
    from scipy.special import ndtr

    variance = float((ranks[kept] ** 2).sum()) / 4
    if variance == 0:
        return 1.0
    z = (plus - float(ranks[kept].sum()) / 2) / math.sqrt(variance)
    return float(2 * ndtr(-abs(z)))


def _rank_biserial(differences: F64) -> Interval:
    size, sign = np.abs(differences), np.sign(differences)
    below = (size[None] < size[:, None]) & (size[None] > 0)
    alike = (size[None] == size[:, None]) & (size[None] > 0)

    def value(weights: F64) -> F64:
        ranks = weights @ below.T + (weights @ alike.T + 1) / 2
        total = (weights * ranks * (size > 0)).sum(axis=1)
        signed = (weights * ranks * sign).sum(axis=1)
        part: F64 = np.divide(signed, total, out=np.full(len(total), math.nan), where=total > 0)
        return part

    return bootstrap(value, len(differences))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p values adjusted for their number by Holm's step-down."""
    count = len(p_values)
    order = sorted(range(count), key=lambda one: p_values[one])
    adjusted, largest = [math.nan] * count, 0.0
    for step, one in enumerate(order):
        largest = max(largest, min(1.0, (count - step) * p_values[one]))
        adjusted[one] = largest
    return adjusted


def nemenyi(mean_ranks: Sequence[float], participants: int) -> list[float]:
    """Return p of each pair of conditions, in the order of `combinations`, from Friedman's mean ranks."""
    k = len(mean_ranks)
    scale = math.sqrt(k * (k + 1) / (6 * participants))
    return [
        _studentized_range_sf(abs(a - b) / scale * math.sqrt(2), k) for a, b in combinations(mean_ranks, 2)
    ]


def _studentized_range_sf(q: float, k: int) -> float:
    """Return the chance that the range of k standard normal values exceeds q."""
    from scipy.special import ndtr

    z = np.linspace(-9.0, 9.0 + q, 4001)
    density = np.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)
    inside = k * np.trapezoid(density * (ndtr(z) - ndtr(z - q)) ** (k - 1), z)  # z: of the greatest
    return float(min(1.0, max(0.0, 1.0 - inside)))


@dataclass(frozen=True)
class ChoiceTest:
    """Whether all conditions are named alike often. p_exact: of a chi2 at least as large; NaN beyond
    `EXACT_CHOICES` participants."""

    counts: tuple[int, ...]
    chi2: float
    df: int
    p: float
    p_exact: float


EXACT_CHOICES = 60


def choice_test(counts: Sequence[int]) -> ChoiceTest:
    """Test counts (k) against equal chances."""
    from scipy.special import chdtrc

    n, k = sum(counts), len(counts)
    chi2 = sum((count - n / k) ** 2 for count in counts) * k / n if n else math.nan
    exact = _exact_choice_p(counts) if 0 < n <= EXACT_CHOICES else math.nan
    return ChoiceTest(tuple(counts), chi2, k - 1, float(chdtrc(k - 1, chi2)), exact)


def _exact_choice_p(counts: Sequence[int]) -> float:
    """Return the chance, with equal chances, of a sum of squared counts at least as large."""
    n, k = sum(counts), len(counts)
    ways = {(0, 0): 1}  # of sequences of choices, by how many are made and their sum of squares
    for _ in range(k):
        more: dict[tuple[int, int], int] = {}
        for (used, squares), number in ways.items():
            for count in range(n - used + 1):
                state = used + count, squares + count**2
                more[state] = more.get(state, 0) + number * math.comb(n - used, count)
        ways = more
    observed = sum(count**2 for count in counts)
    as_large = sum(number for (used, squares), number in ways.items() if used == n and squares >= observed)
    return float(as_large / k**n)
