"""How sure a mean over runs is, by drawing the runs again.

Source: B. Efron and R. J. Tibshirani, *An Introduction to the Bootstrap*, 1993, chapter 13 (percentiles).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from share.types import F64

_DRAWS = 10_000
_LEVEL = 0.95


class Interval(NamedTuple):
    """A figure, and between which values it lies with 95 % confidence; equal to it where there is one run."""

    value: float
    low: float
    high: float


def mean(values: ArrayLike, rng: np.random.Generator) -> Interval:
    """Of values (N,), without those that are NaN; all NaN where none is left."""
    v = np.asarray(values, np.float64)
    return ratio(v, np.ones(len(v)), rng)


def ratio(over: ArrayLike, under: ArrayLike, rng: np.random.Generator) -> Interval:
    """sum(over) / sum(under), (N,) each: runs are drawn in pairs, those with a NaN are left out."""
    a, b = np.asarray(over, np.float64), np.asarray(under, np.float64)
    known = np.isfinite(a) & np.isfinite(b)
    a, b = a[known], b[known]
    if not len(a) or not b.sum():
        return Interval(math.nan, math.nan, math.nan)
    drawn = rng.integers(len(a), size=(_DRAWS, len(a)))
    below = b[drawn].sum(1)
    ratios: F64 = a[drawn].sum(1)[below != 0] / below[below != 0]
    low, high = np.quantile(ratios, [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return Interval(float(a.sum() / b.sum()), float(low), float(high))
