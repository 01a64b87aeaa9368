"""Intervals over participants: by bootstrap, as weights of participants; by Student's t.

Effect sizes that cannot be negative are larger in samples of participants than in all of them, as they are
larger in these than in truth. Bias-corrected percentiles take that back twice. Source: B. Efron, Better
Bootstrap Confidence Intervals, JASA 82, 1987 (BC).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from share.lab.evaluate.statistics import Interval
from share.types import F64

DRAWS = 4000
LEVEL = 0.95
_SEED = 1  # the same data give the same interval
_MAX_CELLS = 1_000_000  # draws x participants


def bootstrap(value: Callable[[F64], F64], participants: int) -> Interval:
    """Return value and 95 % interval of bias-corrected percentiles. value: statistic (D,) of weights (D,
    participants), which say how often each participant is in a sample."""
    draws = max(200, min(DRAWS, _MAX_CELLS // participants))
    rng = np.random.default_rng(_SEED)
    weights = rng.multinomial(participants, np.full(participants, 1 / participants), draws).astype(float)
    whole = float(value(np.ones((1, participants)))[0])
    drawn = value(weights)
    known = drawn[np.isfinite(drawn)]
    if math.isnan(whole) or not len(known):
        return Interval(whole, math.nan, math.nan)
    low, high = np.quantile(known, _corrected_levels(known, whole))
    return Interval(whole, float(low), float(high))


def _corrected_levels(drawn: F64, value: float) -> F64:
    """Return the lower and upper level of the percentiles, moved by how much of the samples lie below."""
    from scipy.special import ndtr, ndtri

    is_same = np.abs(drawn - value) < 1e-12
    below = (drawn[~is_same] < value).sum() + is_same.sum() / 2
    shift = ndtri((below + 0.5) / (len(drawn) + 1))
    levels: F64 = ndtr(2 * shift + ndtri([(1 - LEVEL) / 2, (1 + LEVEL) / 2]))
    return levels


def mean_interval(values: F64) -> Interval:
    """Return the mean of values (N,), without NaN, and its 95 % interval by Student's t."""
    from scipy.special import stdtrit

    known = values[np.isfinite(values)]
    if not len(known):
        return Interval(math.nan, math.nan, math.nan)
    mean = float(known.mean())
    if len(known) < 2:
        return Interval(mean, math.nan, math.nan)
    half = float(stdtrit(len(known) - 1, (1 + LEVEL) / 2) * known.std(ddof=1) / math.sqrt(len(known)))
    return Interval(mean, mean - half, mean + half)
