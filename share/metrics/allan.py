"""Allan deviation of a sensor at rest, and the noise figures that it tells.

Source: IEEE Std 952-1997, annex C; the overlapping estimator of Howe, Allan and Barnes 1981. White noise of
density N gives sigma(tau) = N / sqrt(tau); a random walk of the bias of density K gives K sqrt(tau / 3); bias
instability B gives a flat minimum of 0.664 B.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.errors import DataError
from share.types import F64

_LEAST_SAMPLES = 100
_FLAT = 0.6642823  # sqrt(2 ln 2 / pi)
_OVERLAP = 16
_STEPS = 4  # of the fit's reweighting; it has settled after two


@dataclass(frozen=True, eq=False)
class AllanCurve:
    """taus (T,) s; deviation (T, A) in the unit of the samples, A axes; spans (T,): record length / tau."""

    taus: F64
    deviation: F64
    spans: F64


@dataclass(frozen=True, eq=False)
class AllanFit:
    """Per axis (A,). density u/sqrt(Hz): white noise, at 1 s. walk u/s/sqrt(Hz): of the bias. floor u: bias
    instability, the curve's minimum / 0.664 (no smaller than white noise and walk make it)."""

    density: F64
    walk: F64
    floor: F64


def allan_deviation(samples: F64, rate_hz: float, per_octave: int = 4) -> AllanCurve:
    """Of samples (N, A) at `rate_hz`, over averages of one sample up to a quarter of the record.

    Raises DataError for fewer than 100 samples, or values that are not finite.
    """
    samples = np.asarray(samples, np.float64)
    if len(samples) < _LEAST_SAMPLES:
        raise DataError(f"Allan deviation: {len(samples)} samples, needs {_LEAST_SAMPLES}; record longer")
    if not np.isfinite(samples).all():
        raise DataError("Allan deviation: has samples that are not finite")
    n = len(samples)
    octaves = np.log2(n / 4)
    sizes = np.unique(np.rint(2 ** np.linspace(0, octaves, int(octaves * per_octave) + 1)).astype(int))
    theta = np.concatenate(
        [np.zeros((1, samples.shape[1])), np.cumsum(samples - samples.mean(axis=0), axis=0)]
    )
    deviation = np.stack([_deviation(theta, m) for m in sizes])
    return AllanCurve(sizes / rate_hz, deviation, n / sizes)


def _deviation(theta: F64, m: int) -> F64:
    """Over averages of m samples, from their running sum (N + 1, A): half the mean square of the difference
    of neighbouring averages. Starts lie m / 16 apart: closer ones tell nothing new."""
    step = max(1, m // _OVERLAP)
    second = theta[2 * m :: step] - 2 * theta[m:-m:step] + theta[: -2 * m : step]
    out: F64 = np.sqrt((second**2).mean(axis=0) / 2) / m
    return out


def fit(curve: AllanCurve) -> AllanFit:
    """Density and walk of each axis: sigma^2 = N^2 / tau + K^2 tau / 3, all of the curve at once.

    Weighted by how well each point is known (its variance is near 2 sigma^4 / spans), which needs the
    curve itself: a few rounds, begun with the measured one. Negative parts are zero.
    """
    A = np.stack([1 / curve.taus, curve.taus / 3], axis=1)
    squares = np.stack([_weighted(A, column**2, curve.spans) for column in curve.deviation.T])
    density, walk = np.sqrt(squares).T
    return AllanFit(density, walk, curve.deviation.min(axis=0) / _FLAT)


def _weighted(A: F64, variance: F64, spans: F64) -> F64:
    """(N^2, K^2), neither negative."""
    from scipy.optimize import nnls

    scale, model = np.linalg.norm(A, axis=0), variance
    for _ in range(_STEPS):
        weight = np.sqrt(spans) / model
        solution, _ = nnls(A / scale * weight[:, None], variance * weight)
        model = np.maximum(A / scale @ solution, 1e-6 * variance)
    out: F64 = solution / scale
    return out
