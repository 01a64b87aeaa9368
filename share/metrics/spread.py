"""How a set of errors is summed up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.types import F64


@dataclass(frozen=True)
class Spread:
    """Of n errors, in their unit."""

    rmse: float
    mean: float
    median: float
    max: float
    n: int


def spread(errors: F64) -> Spread:
    """Of errors (N,), N >= 1, none negative."""
    return Spread(
        rmse=float(np.sqrt(np.mean(errors**2))),
        mean=float(errors.mean()),
        median=float(np.median(errors)),
        max=float(errors.max()),
        n=len(errors),
    )
