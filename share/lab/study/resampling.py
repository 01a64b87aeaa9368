"""Effect sizes with intervals over participants: by bootstrap, as weights of participants; by Student's t."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from share.lab.evaluate.statistics import Interval
from share.types import F64

DRAWS = 4000
LEVEL = 0.95
_SEED = 1  # the same data give the same interval
_MAX_CELLS = 4_000_000  # draws x participants


def bootstrap(value: Callable[[F64], F64], participants: int) -> Interval:
    """Return value and 95 % percentile interval. value: statistic (D,) of weights (D, participants), which
    say how often each participant is in a sample."""
    draws = max(200, min(DRAWS, _MAX_CELLS // participants))
    rng = np.random.default_rng(_SEED)
    weights = rng.multinomial(participants, np.full(participants, 1 / participants), draws).astype(float)
    whole = float(value(np.ones((1, participants)))[0])
    drawn = value(weights)
    known = drawn[np.isfinite(drawn)]
    if math.isnan(whole) or not len(known):
        return Interval(whole, math.nan, math.nan)
    low, high = np.quantile(known, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(whole, float(low), float(high))


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
