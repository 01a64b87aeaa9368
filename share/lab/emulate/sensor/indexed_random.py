"""Random numbers by index: independent of the order and span of requests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from share.types import F64, I64

Seed = tuple[int, ...]
_BLOCK_SIZE = 4096  # indices that share one generator
_Draw = Callable[[np.random.Generator, int], Any]


def uniform(seed: Seed, index: I64) -> F64:
    """Return a number in [0, 1) for each index (N,), which must not be negative."""
    return _draw_by_index(seed, index, lambda rng, n: rng.random(n))


def normal(seed: Seed, index: I64) -> F64:
    """Return a standard normal number for each index (N,), which must not be negative."""
    return _draw_by_index(seed, index, lambda rng, n: rng.standard_normal(n))


def _draw_by_index(seed: Seed, index: I64, draw: _Draw) -> F64:
    out = np.empty(len(index))
    block = index // _BLOCK_SIZE
    for number in np.unique(block):
        rows = block == number
        values = draw(np.random.default_rng((*seed, int(number))), _BLOCK_SIZE)
        out[rows] = values[index[rows] % _BLOCK_SIZE]
    return out
