"""Orders in which participants meet the conditions, balanced for place and first-order carry-over.

A Williams square of an even number of conditions k has k orders, of an odd number two squares have 2 k: each
condition is as often in each place, and follows each other one as often. Each square is a Latin square, so
after any multiple of k orders all places are taken alike, but for odd k, after one square of a pair, some
conditions follow each other twice more than others. Of a last square that is not filled, the rows are those
that leave the successions most even; places then differ by one at most, successions by one (even k) or two.
All k! orders fall into such blocks, no two of which share an order, so no order comes twice before all have
come.

Source: E. J. Williams, Experimental designs balanced for the estimation of residual effects of treatments,
Australian Journal of Scientific Research A 2, 1949.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from share.types import I64

MIN_CONDITIONS, MAX_CONDITIONS = 2, 8


def draw_orders(conditions: int, participants: int, rng: np.random.Generator) -> I64:
    """Return orders (participants, conditions) of condition numbers from 0. Raises ValueError."""
    if not MIN_CONDITIONS <= conditions <= MAX_CONDITIONS:
        raise ValueError(f"{conditions} conditions; {MIN_CONDITIONS} to {MAX_CONDITIONS} can be balanced")
    squares = _williams(conditions)
    total = math.factorial(conditions) // (len(squares) * conditions)
    rows: list[I64] = []
    used: set[tuple[int, ...]] = set()
    while len(rows) < participants:
        block = rng.permutation(conditions)[squares]
        name = min(tuple(row) for square in block.tolist() for row in square)
        if name in used:
            continue
        used.add(name)
        if len(used) == total:  # all orders have been used: begin again
            used.clear()
        for square in rng.permutation(block):
            rows += _rows_of_square(rng.permutation(square), participants - len(rows), rows)
    return np.array(rows, np.int64)


def _williams(k: int) -> I64:
    """Return a Williams square (1, k, k), for odd k a pair of them (2, k, k): 0, 1, k-1, 2, … and its
    shifts."""
    first = [(n + 1) // 2 if n % 2 else (k - n // 2) % k for n in range(k)]
    square = (np.array(first) + np.arange(k)[:, None]) % k
    return np.array([square, square[:, ::-1]] if k % 2 else [square])


def _rows_of_square(square: I64, wanted: int, before: list[I64]) -> list[I64]:
    """Return the square's rows; if fewer are wanted, those with the least imbalance after the ones before."""
    if wanted >= len(square):
        return list(square)
    choices = (square[list(rows)] for rows in combinations(range(len(square)), wanted))
    return list(min(choices, key=lambda rows: _imbalance(np.array([*before, *rows]))))


def _imbalance(orders: I64) -> int:
    return int((Balance.of(orders).successions ** 2).sum())


@dataclass(frozen=True)
class Balance:
    """places (k, k): how often condition i is in place j. successions (k, k): how often j comes right after
    i. distinct: how many different orders there are."""

    places: I64
    successions: I64
    distinct: int

    @staticmethod
    def of(orders: I64) -> Balance:
        """Count over orders (participants, k)."""
        k = orders.shape[1]
        places, successions = np.zeros((k, k), np.int64), np.zeros((k, k), np.int64)
        np.add.at(places, (orders, np.arange(k)[None]), 1)
        np.add.at(successions, (orders[:, :-1], orders[:, 1:]), 1)
        return Balance(places, successions, len(set(map(tuple, orders.tolist()))))

    @property
    def is_exact(self) -> bool:
        """Whether all places are taken alike, and all successions are as frequent."""
        return len(set(self.places.ravel().tolist())) == 1 == len(set(self._pairs()))

    def _pairs(self) -> list[int]:
        k = len(self.places)
        return [int(self.successions[i, j]) for i in range(k) for j in range(k) if i != j]

    def lines(self, names: list[str]) -> list[str]:
        """Say what is balanced and what exactly is not, conditions by their names."""
        k = len(names)
        places = [
            (f"{names[i]} in place {j + 1}", int(self.places[i, j])) for i in range(k) for j in range(k)
        ]
        pairs = [
            (f"{names[j]} right after {names[i]}", int(self.successions[i, j]))
            for i in range(k)
            for j in range(k)
            if i != j
        ]
        return [
            f"{self.distinct} different order{'s' * (self.distinct > 1)} of {int(self.places[0].sum())}",
            _counts_line("each condition in each place", places),
            _counts_line("each condition right after each other", pairs),
        ]


def _counts_line(what: str, counts: list[tuple[str, int]]) -> str:
    tally = Counter(count for _, count in counts)
    if len(tally) == 1:
        return f"{what}: {_times(counts[0][1])}"
    usual = max(tally, key=lambda count: (tally[count], -count))
    groups = [
        f"{_times(count)}: {', '.join(name for name, one in counts if one == count)}"
        for count in sorted(tally)
        if count != usual
    ]
    return f"{what}: NOT BALANCED: mostly {_times(usual)}; {'; '.join(groups)}"


def _times(count: int) -> str:
    return {0: "never", 1: "once", 2: "twice"}.get(count, f"{count} times")
