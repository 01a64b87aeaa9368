"""Repeated-measures ANOVA of values (participants, conditions), a model of order effects, and power.

Sources: J. W. Mauchly, Annals of Mathematical Statistics 11, 1940, with the second-order p of R's
`mauchly.test`; S. W. Greenhouse and S. Geisser, Psychometrika 24, 1959; H. Huynh and L. S. Feldt, Journal of
Educational Statistics 1, 1976; S. Olejnik and J. Algina, Psychological Methods 8, 2003 (generalised eta
squared); J. H. Steiger, Psychological Methods 9, 2004 (interval by the noncentral F); B. Jones and M. G.
Kenward, Design and Analysis of Cross-Over Trials, 2014.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from share.lab.evaluate.statistics import Interval
from share.lab.study.resampling import LEVEL, bootstrap, mean_interval
from share.types import F64, I64

_ROUNDING = 1e-22  # part of a sum of squares, below which a sum is of rounding errors


@dataclass(frozen=True)
class Sphericity:
    """Mauchly's test, NaN with two conditions or a singular covariance, as of too few participants; epsilons,
    1 where variances of all differences are alike."""

    w: float
    chi2: float
    p: float
    greenhouse_geisser: float
    huynh_feldt: float


@dataclass(frozen=True)
class RepeatedAnova:
    """p_gg, p_hf: with degrees of freedom times the epsilon. partial_eta2: interval by the noncentral F, as
    if spherical. generalised_eta2: interval by bootstrap over participants."""

    f: float
    df: int
    df_error: int
    p: float
    p_gg: float
    p_hf: float
    sphericity: Sphericity
    partial_eta2: Interval
    generalised_eta2: Interval
    participants: int


def repeated_anova(values: F64) -> RepeatedAnova:
    """Test whether the conditions' means differ; NaN where nothing varies within participants."""
    n, k = values.shape
    df, df_error = k - 1, (n - 1) * (k - 1)
    means = values.mean(axis=0) - values.mean()
    effect = n * float((means**2).sum())
    error = float(((values - values.mean(axis=1, keepdims=True) - means) ** 2).sum())
    f = effect / df / (error / df_error) if error > _ROUNDING * float((values**2).sum()) else math.nan
    sphericity = Sphericity(*[math.nan] * 5) if math.isnan(f) else _sphericity(values)
    gg, hf = sphericity.greenhouse_geisser, sphericity.huynh_feldt
    p, p_gg, p_hf = (_f_sf(df * eps, df_error * eps, f) for eps in (1.0, gg, hf))
    return RepeatedAnova(
        f,
        df,
        df_error,
        p,
        p_gg,
        p_hf,
        sphericity,
        _partial_eta2(f, df, df_error),
        bootstrap(lambda weights: _generalised_eta2(values - values.mean(), weights), n),
        n,
    )


def _f_sf(df: float, df_error: float, f: float) -> float:
    from scipy.special import fdtrc

    return float(fdtrc(df, df_error, f)) if df_error > 0 else math.nan


def _sphericity(values: F64) -> Sphericity:
    from scipy.special import chdtrc

    n, k = values.shape
    d = k - 1
    if d == 1:
        return Sphericity(math.nan, math.nan, math.nan, 1.0, 1.0)
    contrasts = _orthonormal_contrasts(k)
    cov = contrasts @ np.cov(values, rowvar=False) @ contrasts.T
    gg = min(1.0, float(np.trace(cov)) ** 2 / (d * float((cov**2).sum())))
    spare = d * (n - 1 - d * gg)
    hf = min(1.0, (n * d * gg - 2) / spare) if spare > 0 else 1.0
    if n - 1 < d or (w := _mauchly_w(cov)) <= 0:
        return Sphericity(math.nan, math.nan, math.nan, gg, hf)
    factor = 1 - (2 * d**2 + d + 2) / (6 * d * (n - 1))
    chi2, df = -(n - 1) * factor * math.log(w), d * (d + 1) // 2 - 1
    second = (d + 2) * (d - 1) * (d - 2) * (2 * d**3 + 6 * d**2 + 3 * k + 2)
    weight = second / (288 * ((n - 1) * d * factor) ** 2)
    p, p_more = float(chdtrc(df, chi2)), float(chdtrc(df + 4, chi2))
    return Sphericity(w, chi2, p + weight * (p_more - p), gg, hf)


def _mauchly_w(cov: F64) -> float:
    d = len(cov)
    scaled = cov / (np.trace(cov) / d)
    if np.linalg.matrix_rank(scaled) < d:
        return 0.0
    return min(1.0, float(np.linalg.det(scaled)))


def _orthonormal_contrasts(k: int) -> F64:
    """Return (k - 1, k): Helmert's contrasts."""
    rows = np.tril(np.ones((k, k)), -1)[1:]
    rows[np.arange(k - 1), np.arange(1, k)] = -np.arange(1, k)
    contrasts: F64 = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return contrasts


def _generalised_eta2(values: F64, weights: F64) -> F64:
    """Return the effect's part of all variation, differences between participants included, for weights (D,
    n) of participants."""
    n, k = values.shape
    grand = weights @ values.mean(axis=1) / n
    effect = n * ((weights @ values / n - grand[:, None]) ** 2).sum(axis=1)
    squares = weights @ (values**2).sum(axis=1)
    total = squares - n * k * grand**2
    part: F64 = np.divide(effect, total, out=np.full(len(total), math.nan), where=total > 1e-12 * squares)
    return part


def _partial_eta2(f: float, df: int, df_error: int) -> Interval:
    if math.isnan(f):
        return Interval(math.nan, math.nan, math.nan)
    bounds = noncentrality_interval(f, df, df_error)
    count = df + df_error + 1
    low, high = (1 - count / (one + count) for one in bounds)  # one may be infinite
    return Interval(f * df / (f * df + df_error), low, high)


def noncentrality_interval(f: float, df: float, df_error: float) -> tuple[float, float]:
    """Return the 95 % interval of the noncentrality of F: the noncentralities under which f is the upper and
    lower 2.5 % quantile; 0 where there is none, infinite beyond a million."""
    low, high = (_noncentrality(f, df, df_error, chance) for chance in ((1 + LEVEL) / 2, (1 - LEVEL) / 2))
    return low, high


_MAX_NONCENTRALITY = 1e6


def _noncentrality(f: float, df: float, df_error: float, chance: float) -> float:
    """Return the noncentrality under which an F below f has this chance, by bisection, as it falls with it.

    scipy's `ncfdtrinc` stops at 10,000 without a word."""
    from scipy.special import fdtr, ncfdtr

    if fdtr(df, df_error, f) <= chance:
        return 0.0
    high = 1.0
    while not ncfdtr(df, df_error, high, f) < chance:
        high *= 2
        if high > _MAX_NONCENTRALITY:
            return math.inf
    low = high / 2 if high > 1 else 0.0
    while high - low > 1e-9 * high:
        middle = (low + high) / 2
        if ncfdtr(df, df_error, middle, f) < chance:
            high = middle
        else:
            low = middle
    return (low + high) / 2


# Order effects.


@dataclass(frozen=True)
class PartialF:
    """Whether a group of terms of a linear model is needed, beside all others."""

    f: float
    df: int
    df_error: int
    p: float


@dataclass(frozen=True)
class OrderEffects:
    """Of the model value = participant + condition + place + condition before. slope: mean change a place,
    of values less their condition's mean, with an interval by Student's t over participants."""

    place: PartialF
    carry_over: PartialF
    slope: Interval


def order_effects(values: F64, places: I64) -> OrderEffects:
    """Test effects of place and of the condition before on values (P, C), NaN where missing; places (P, C)
    from 1, 0 where unknown: such values are left out."""
    known = np.isfinite(values) & (places > 0)
    person, condition = np.nonzero(known)
    y, place = values[known], places[known]
    count, k = values.shape
    before = np.array([_before(places[one], at) for one, at in zip(person, place, strict=True)], int)
    blocks = {
        "participant": np.eye(count)[person],
        "condition": np.eye(k)[condition],
        "place": np.eye(k)[place - 1],
        "carry-over": _sum_coded(before, k),
    }
    centred = values - _column_means(np.where(known, values, math.nan))
    slopes = [
        _slope(row[is_known], at[is_known]) for row, at, is_known in zip(centred, places, known, strict=True)
    ]
    return OrderEffects(
        _partial_f(y, blocks, "place"),
        _partial_f(y, blocks, "carry-over"),
        mean_interval(np.array(slopes, float)),
    )


def _before(row: I64, place: int) -> int:
    """Return the condition that a participant met just before, -1 for none."""
    found = np.flatnonzero(row == place - 1)
    return int(found[0]) if place > 1 and len(found) else -1


def _sum_coded(before: np.ndarray, k: int) -> F64:
    """Return (N, k - 1): effects of the condition before, which sum to 0; zeros where there is none."""
    codes = np.concatenate([np.eye(k)[:, : k - 1], np.zeros((1, k - 1))])
    codes[k - 1] = -1
    coded: F64 = codes[before]
    return coded


def _column_means(values: F64) -> F64:
    count = np.isfinite(values).sum(axis=0)
    means: F64 = np.nansum(values, axis=0) / np.maximum(count, 1)
    return means


def _slope(values: F64, places: I64) -> float:
    if len(values) < 2:
        return math.nan
    x = places - places.mean()
    return float((x * values).sum() / (x**2).sum())


def _partial_f(y: F64, blocks: dict[str, F64], name: str) -> PartialF:
    full = np.concatenate(list(blocks.values()), axis=1)
    reduced = np.concatenate([block for other, block in blocks.items() if other != name], axis=1)
    (rss, rank), (rss_without, rank_without) = (_fit(y, design) for design in (full, reduced))
    df, df_error = rank - rank_without, len(y) - rank
    if df < 1 or df_error < 1 or rss <= _ROUNDING * float(y @ y):
        return PartialF(math.nan, df, df_error, math.nan)
    f = (rss_without - rss) / df / (rss / df_error)
    return PartialF(f, df, df_error, _f_sf(df, df_error, f))


def _fit(y: F64, design: F64) -> tuple[float, int]:
    """Return the sum of squared residuals and the rank of the design."""
    solution, _, rank, _ = np.linalg.lstsq(design, y)
    return float(((y - design @ solution) ** 2).sum()), int(rank)
