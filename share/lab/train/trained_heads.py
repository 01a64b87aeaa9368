"""What has been taught, as arrays: weights of the heads, how wide their intervals are, what they know."""

from __future__ import annotations

import io
import json
import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import DataError
from share.files.arrays import read_arrays
from share.files.json_file import parse_json
from share.files.reading import MB
from share.files.writing import atomic_write
from share.types import F32, F64

INTERVAL_COVERAGE = 0.9  # of all errors lie in their intervals
KNOWN_QUANTILE = 0.99  # of what it was calibrated on is no further than what it knows
_MAX_BYTES = 200 * MB  # four heads have 1.6
_RIDGE = 1e-3  # of a variance, added


@dataclass(frozen=True, eq=False)
class TrainedHeads:
    """heads: weights of each `share.lab.train.network.Head`, for inputs as they come
    (`fold_standardisation`). margin: by
    which low and high go further out, in logarithms. mean (96,), whitening (96, 96): a vector x that the
    first head joined is as far from what was learnt as |(x - mean) whitening|, 1 where that ends. about:
    plain data."""

    heads: list[dict[str, F32]]
    margin: float
    mean: F32
    whitening: F32
    about: dict[str, Any]


def fold_standardisation(weights: dict[str, F32], layer: str, mean: F32, deviation: F32) -> dict[str, F32]:
    """`weights` with a linear `layer` that takes x in place of (x - mean) / deviation."""
    W, b = weights[f"{layer}.weight"] / deviation, weights[f"{layer}.bias"]
    return weights | {
        f"{layer}.weight": W.astype(np.float32),
        f"{layer}.bias": (b - W @ mean).astype(np.float32),
    }


def conformal_margin(predicted: F32, log_error: F32, coverage: float = INTERVAL_COVERAGE) -> float:
    """By which (N, 3) intervals have to go further out on both sides, so that a new one of their sort covers
    its error with probability `coverage` (conformalised quantile regression, Romano et al. 2019)."""
    excess = np.sort(np.maximum(predicted[:, 1] - log_error, log_error - predicted[:, 2]))
    rank = math.ceil((len(excess) + 1) * coverage)
    return float(excess[min(rank, len(excess)) - 1])


def mahalanobis_scale(training: F32, calibration: F32) -> tuple[F32, F32]:
    """Mean and whitening for `TrainedHeads`, of what was learnt (N, 96) and what it was calibrated on (M,
    96): the Mahalanobis distance, in parts of the one that `KNOWN_QUANTILE` of the latter keep."""
    mean = training.mean(axis=0, dtype=np.float64)
    cov = np.cov(training.T.astype(np.float64))
    cov += _RIDGE * np.trace(cov) / len(cov) * np.eye(len(cov))
    whitening: F64 = np.linalg.inv(np.linalg.cholesky(cov)).T
    radius = np.quantile(np.linalg.norm((calibration - mean) @ whitening, axis=1), KNOWN_QUANTILE)
    return mean.astype(np.float32), (whitening / radius).astype(np.float32)


def write_trained(path: Path, fitted: TrainedHeads) -> None:
    """Whole or not at all."""
    data = io.BytesIO()
    numbered = enumerate(fitted.heads)
    arrays: dict[str, Any] = {f"{k}/{name}": value for k, head in numbered for name, value in head.items()}
    arrays |= {"mean": fitted.mean, "whitening": fitted.whitening, "margin": np.array(fitted.margin)}
    np.savez_compressed(data, about=np.array(json.dumps(fitted.about)), **arrays)
    atomic_write(path, data.getvalue())


def read_trained(path: Path) -> TrainedHeads:
    """Raises DataError that names it."""
    arrays = read_arrays(path, "is not by `share train fit`", _MAX_BYTES)
    try:
        about = parse_json(str(arrays.pop("about")))
        if bad := [name for name, value in arrays.items() if not np.isfinite(value).all()]:
            raise ValueError(f"{bad[0]} is not finite")
        heads: defaultdict[str, dict[str, F32]] = defaultdict(dict)
        for number, _, name in (key.partition("/") for key in arrays if "/" in key):
            heads[number][name] = arrays[f"{number}/{name}"]
        return TrainedHeads(
            list(heads.values()), float(arrays["margin"]), arrays["mean"], arrays["whitening"], about
        )
    except (KeyError, ValueError, TypeError) as error:
        raise DataError(f"{path}: is not by `share train fit`, or damaged: {error!r:.200}") from None
