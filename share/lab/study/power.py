"""Power of the next study: RM-ANOVA by the noncentral F, Friedman by resampling the participants of this one.

Both take the effect as it was found here. Noise makes found effects too large on average: the first takes the
estimate of noncentrality without that bias, (F df (df_error - 2) / df_error) - df, and 0 below; the second
does not. Source: J. Cohen, Statistical Power Analysis for the Behavioral Sciences, 1988.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from share.lab.study.rank_tests import average_ranks
from share.lab.study.repeated_anova import RepeatedAnova, noncentrality_interval
from share.types import F64

ALPHA, _POWER = 0.05, 0.8
_SIZES = (8, 12, 16, 20, 24, 32, 40, 60, 80)
_RESAMPLES = 2000
_SEED = 1
_MAX_PARTICIPANTS = 500  # of a next study


def anova_power(noncentrality: float, conditions: int, participants: int, epsilon: float = 1.0) -> float:
    """Return the power of a repeated-measures ANOVA at 5 %. noncentrality: of each participant, for epsilon
    1: f² k / (1 - ρ), with f the spread of means by that of values, and ρ the correlation of conditions."""
    from scipy.special import fdtri, ncfdtr

    df = (conditions - 1) * epsilon
    df_error = (participants - 1) * df
    critical = float(fdtri(df, df_error, 1 - ALPHA))
    return 1.0 - float(ncfdtr(df, df_error, participants * noncentrality * epsilon, critical))


def friedman_power(values: F64, participants: int) -> float:
    """Return how often Friedman's test has p < 0.05 over samples, with replacement, of so many of the
    participants whose values (n, k) these are."""
    from scipy.special import chdtrc

    n, k = values.shape
    ranks = np.array([average_ranks(row) for row in values])
    spread = ((ranks - (k + 1) / 2) ** 2).sum(axis=1)
    rng = np.random.default_rng(_SEED)
    weights = rng.multinomial(participants, np.full(n, 1 / n), _RESAMPLES)
    deviation = weights @ ranks - participants * (k + 1) / 2
    within = weights @ spread
    chi2 = np.divide(
        (k - 1) * (deviation**2).sum(axis=1), within, out=np.zeros(len(within)), where=within > 0
    )
    return float((chdtrc(k - 1, chi2) < ALPHA).mean())


@dataclass(frozen=True)
class NextStudy:
    """Power by number of participants. needed: participants for 80 % by ANOVA; None where over 500.
    needed_at_worst: the same for the lower bound of the effect's 95 % interval."""

    sizes: tuple[int, ...]
    anova: tuple[float, ...]
    friedman: tuple[float, ...]
    needed: int | None
    needed_at_worst: int | None


def next_study(values: F64, anova: RepeatedAnova) -> NextStudy | None:
    """Return power with the effect found in values (n, k); None where there is no F."""
    if math.isnan(anova.f) or anova.df_error < 3:
        return None
    k, epsilon = anova.df + 1, anova.sphericity.greenhouse_geisser
    unbiased = anova.f * anova.df * (anova.df_error - 2) / anova.df_error - anova.df
    each = max(0.0, unbiased) / anova.participants
    worst = noncentrality_interval(anova.f, anova.df, anova.df_error)[0] / anova.participants
    return NextStudy(
        _SIZES,
        tuple(anova_power(each, k, size, epsilon) for size in _SIZES),
        tuple(friedman_power(values, size) for size in _SIZES),
        _needed(each, k, epsilon),
        _needed(worst, k, epsilon),
    )


def _needed(noncentrality: float, conditions: int, epsilon: float) -> int | None:
    """Return the least number of participants with 80 % power, by bisection: it rises with them."""
    low, high = 2, _MAX_PARTICIPANTS
    if math.isinf(noncentrality):
        return low
    if not anova_power(noncentrality, conditions, high, epsilon) >= _POWER:
        return None
    while low < high:
        middle = (low + high) // 2
        if anova_power(noncentrality, conditions, middle, epsilon) < _POWER:
            low = middle + 1
        else:
            high = middle
    return low
