"""Points of an image by the cells of a grid over it."""

from __future__ import annotations

import numpy as np

from share.types import F32, F64, I64

Size = tuple[int, int]  # width, height


def cells(px: F32 | F64 | I64, size: Size, grid: Size) -> I64:
    """The cell (N,), row by row, of each of px (N, 2) in an image of `size`."""
    at = (px * grid / size).astype(np.int64).clip(0, np.array(grid) - 1)
    out: I64 = at[:, 1] * grid[0] + at[:, 0]
    return out


def evenly(px: F32 | I64, strength: F32 | F64, size: Size, grid: Size, taken: F32 | None = None) -> I64:
    """An order (N,): the strongest of each cell, then the second strongest, and so on; those that rank
    alike by strength. taken (M, 2): points that are there already rank first in their cells."""
    cell = cells(px, size, grid)
    order = np.lexsort((-strength, cell))
    first = np.searchsorted(cell[order], np.arange(grid[0] * grid[1]))
    rank = np.arange(len(px)) - first[cell[order]]  # how many of its own cell are stronger
    if taken is not None:
        rank = rank + np.bincount(cells(taken, size, grid), minlength=len(first))[cell[order]]
    out: I64 = order[np.lexsort((-strength[order], rank))]
    return out
