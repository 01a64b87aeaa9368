"""How sure a mean over runs is, by drawing their sessions again.

Runs of one session with several seeds have the room and the ways in common, so it is sessions that are drawn,
each with all its runs: were runs drawn, three seeds would look like three rooms. Sources: B. Efron and
R. J. Tibshirani, *An Introduction to the Bootstrap*, 1993, chapter 13 (percentiles); A. C. Davison and
D. V. Hinkley, *Bootstrap Methods and their Application*, 1997, section 3.8 (groups).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from share.types import F64

_DRAWS = 10_000
_LEVEL = 0.95


class Interval(NamedTuple):
    """A figure, and between which values it lies with 95 % confidence; NaN where one session cannot tell."""

    value: float
    low: float
    high: float


def mean(values: ArrayLike, sessions: Sequence[str], rng: np.random.Generator) -> Interval:
    """Of values (N,) of runs on `sessions` (N), without those that are NaN; all NaN where none is left."""
    v = np.asarray(values, np.float64)
    return ratio(v, np.ones(len(v)), sessions, rng)


def ratio(over: ArrayLike, under: ArrayLike, sessions: Sequence[str], rng: np.random.Generator) -> Interval:
    """sum(over) / sum(under), (N,) each, of pairs of runs on `sessions` (N); without pairs with a NaN."""
    a, b = np.asarray(over, np.float64), np.asarray(under, np.float64)
    known = np.isfinite(a) & np.isfinite(b)
    names, of = np.unique(np.array(sessions, str)[known], return_inverse=True)
    count = len(names)
    a, b = (np.bincount(of, values[known], count).astype(np.float64) for values in (a, b))
    if not b.sum():
        return Interval(math.nan, math.nan, math.nan)
    value = float(a.sum() / b.sum())
    if count == 1:
        return Interval(value, math.nan, math.nan)
    drawn = rng.integers(count, size=(_DRAWS, count))
    below = b[drawn].sum(1)
    ratios: F64 = a[drawn].sum(1)[below != 0] / below[below != 0]
    low, high = np.quantile(ratios, [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return Interval(value, float(low), float(high))
