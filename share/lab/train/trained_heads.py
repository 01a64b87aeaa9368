"""Trained heads as arrays: weights, width of the intervals, and the domain of the training data."""

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

INTERVAL_COVERAGE = 0.9  # share of errors that should lie in their intervals
KNOWN_QUANTILE = 0.99  # quantile of the calibration data's distances that is distance 1
_MAX_BYTES = 200 * MB  # four heads take 1.6 MB
_RIDGE = 1e-3  # relative ridge added to the variances


@dataclass(frozen=True, eq=False)
class TrainedHeads:
    """heads: weights of each `share.lab.train.network.Head`, for inputs that are not standardised
    (`fold_standardisation`). margin: widens the interval on both sides, log. mean (96,), whitening (96, 96):
    the distance of a joined vector x of the first head from the training data is |(x - mean) whitening|; 1 is
    its limit. about: plain metadata."""

    heads: list[dict[str, F32]]
    margin: float
    mean: F32
    whitening: F32
    about: dict[str, Any]


def fold_standardisation(weights: dict[str, F32], layer: str, mean: F32, deviation: F32) -> dict[str, F32]:
    """Return `weights` with the linear `layer` changed to take x in place of (x - mean) / deviation."""
    W, b = weights[f"{layer}.weight"] / deviation, weights[f"{layer}.bias"]
    return weights | {
        f"{layer}.weight": W.astype(np.float32),
        f"{layer}.bias": (b - W @ mean).astype(np.float32),
    }


def conformal_margin(predicted: F32, log_error: F32) -> float:
    """Return the margin by which intervals of predicted (N, 3) must widen on both sides to cover a new error
    with probability `INTERVAL_COVERAGE` (conformalised quantile regression, Romano et al. 2019)."""
    excess = np.sort(np.maximum(predicted[:, 1] - log_error, log_error - predicted[:, 2]))
    rank = math.ceil((len(excess) + 1) * INTERVAL_COVERAGE)
    return float(excess[min(rank, len(excess)) - 1])


def mahalanobis_scale(training: F32, calibration: F32) -> tuple[F32, F32]:
    """Return mean (96,) and whitening (96, 96) for `TrainedHeads` from joined vectors of training (N, 96) and
    calibration (M, 96) data: a Mahalanobis distance, scaled so that the `KNOWN_QUANTILE` of the calibration
    data is at 1."""
    mean = training.mean(axis=0, dtype=np.float64)
    cov = np.cov(training.T.astype(np.float64))
    cov += _RIDGE * np.trace(cov) / len(cov) * np.eye(len(cov))
    whitening: F64 = np.linalg.inv(np.linalg.cholesky(cov)).T
    radius = np.quantile(np.linalg.norm((calibration - mean) @ whitening, axis=1), KNOWN_QUANTILE)
    return mean.astype(np.float32), (whitening / radius).astype(np.float32)


def write_trained(path: Path, fitted: TrainedHeads) -> None:
    """Write the heads atomically."""
    data = io.BytesIO()
    numbered = enumerate(fitted.heads)
    arrays: dict[str, Any] = {f"{k}/{name}": value for k, head in numbered for name, value in head.items()}
    arrays |= {"mean": fitted.mean, "whitening": fitted.whitening, "margin": np.array(fitted.margin)}
    np.savez_compressed(data, about=np.array(json.dumps(fitted.about)), **arrays)
    atomic_write(path, data.getvalue())


def read_trained(path: Path) -> TrainedHeads:
    """Read trained heads. Raises DataError that names the file."""
    arrays = read_arrays(path, "not a file of `share train fit`", _MAX_BYTES)
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
        raise DataError(f"{path}: not a file of `share train fit`, or damaged: {error!r:.200}") from None
