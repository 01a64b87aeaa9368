"""Allan deviation of a sensor at rest, over segments without gaps.

Source: IEEE Std 952-1997, annex C; the overlapping estimator of Howe, Allan and Barnes 1981 (NIST SP 1065,
5.2.4). Noise from the curve: `share.lab.calibrate.imu_noise`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from share.errors import DataError
from share.types import F64, I64

_MIN_SAMPLES = 100
_STARTS_PER_AVERAGE = 16
_SIZES_PER_OCTAVE = 4


@dataclass(frozen=True, eq=False)
class AllanCurve:
    """sizes (T,): samples in an average. deviation (T, A) in the unit of the samples, A axes.
    segment_lengths (S,): samples of each segment. rate_hz: of the samples."""

    sizes: I64
    deviation: F64
    segment_lengths: I64
    rate_hz: float

    @property
    def taus(self) -> F64:
        """(T,) averaging times, s."""
        return np.asarray(self.sizes / self.rate_hz, np.float64)

    @property
    def clusters(self) -> I64:
        """(T,) numbers of independent, adjacent averages: in each segment as many as fit, if at least two."""
        averages = self.segment_lengths // self.sizes[:, None]
        return np.asarray(np.where(averages >= 2, averages, 0).sum(axis=1), np.int64)


def allan_deviation(samples: F64 | Sequence[F64], rate_hz: float) -> AllanCurve:
    """Return the Allan deviation of samples (N, A) at `rate_hz`, or of several segments with gaps between
    them.

    No difference spans a gap. Averages of one sample up to a quarter of the longest segment. Raises DataError
    where no segment has 100 samples, or for values that are not finite.
    """
    segments_given = [samples] if isinstance(samples, np.ndarray) else samples
    segments = [np.asarray(one, np.float64) for one in segments_given if len(one) >= 2]
    longest = max(map(len, segments), default=0)
    if longest < _MIN_SAMPLES:
        raise DataError(f"Allan deviation: {longest} samples in a row, needs {_MIN_SAMPLES}; record longer")
    if not all(np.isfinite(s).all() for s in segments):
        raise DataError("Allan deviation: has samples that are not finite")
    octaves = np.log2(longest / 4)
    powers = np.linspace(0, octaves, int(octaves * _SIZES_PER_OCTAVE) + 1)
    sizes = np.unique(np.rint(2**powers).astype(np.int64))
    sums = [np.cumsum(one - one.mean(axis=0), axis=0) for one in segments]  # the mean does not matter
    total = np.sum([_squared_differences(np.pad(one, ((1, 0), (0, 0))), sizes) for one in sums], axis=0)
    return AllanCurve(
        sizes=sizes,
        deviation=np.sqrt(total[:, :-1] / total[:, -1:] / 2) / sizes[:, None],
        segment_lengths=np.array([len(s) for s in segments], np.int64),
        rate_hz=rate_hz,
    )


def _squared_differences(theta: F64, sizes: I64) -> F64:
    """Return (T, A + 1): sums of squared second differences of the running sum at each size, and their
    number."""
    out = np.zeros((len(sizes), theta.shape[1] + 1))
    for row, m in zip(out, sizes, strict=True):
        if 2 * m < len(theta):
            step = max(1, m // _STARTS_PER_AVERAGE)  # denser starts add no information
            second = theta[2 * m :: step] - 2 * theta[m:-m:step] + theta[: -2 * m : step]
            row[:-1], row[-1] = (second**2).sum(axis=0), len(second)
    return out


# Covariance of the Allan variances of one recording.
#
# A running sum of samples with white noise, flicker noise and a random walk has stationary second
# differences, whose covariances follow from one function of the lag (a generalised covariance: Matheron 1973)
#
#     G(h) = -N^2 |h| / 2  +  B^2 h^2 ln|h| / (2 pi)  +  K^2 |h|^3 / 12
#
# and a mean of squares of normal values has the covariance 2 sum R(k)^2 / n^2 (Isserlis). That gives the
# equivalent degrees of freedom of NIST SP 1065, 5.4, for any mixture of the three, and the covariance between
# averaging times, which fits usually ignore: neighbours are nearly copies.

_WIDE_LAGS = 65  # lags over all of a sum
_CORNER_LAGS = 33  # lags about each of its nine corners
_SECOND_DIFFERENCE = np.array([1.0, -2.0, 1.0])


_NOISE_MODELS: tuple[Callable[[F64], F64], ...] = (
    lambda h: -h / 2,
    lambda h: h * h * np.log(np.maximum(h, 1e-300)) / (2 * np.pi),
    lambda h: h**3 / 12,
)


def variance_covariance(sizes: I64, lengths: I64, rate_hz: float) -> F64:
    """Return (3, 3, T, T), read-only: with squares p = (N^2, B^2, K^2) of an axis, sum_ab p_a p_b out[a, b]
    is the covariance of its Allan variances at T sizes, over segments of `lengths` (S,) samples."""
    return _variance_covariance(tuple(sizes.tolist()), tuple(lengths.tolist()), rate_hz)


@lru_cache(maxsize=2)  # a recording's gyroscope and accelerometer have the same
def _variance_covariance(sizes: tuple[int, ...], lengths: tuple[int, ...], rate_hz: float) -> F64:
    out, counts = np.zeros((3, 3, len(sizes), len(sizes))), np.array(lengths, np.int64)
    for i, m in enumerate(sizes):
        for j, n in enumerate(sizes[: i + 1]):
            out[:, :, i, j] = out[:, :, j, i] = _pair_covariance(m, n, counts, 1 / rate_hz)
    out.setflags(write=False)
    return out


def _pair_covariance(m: int, n: int, lengths: I64, dt: float) -> F64:
    """Return (3, 3) of the variances at m and n samples."""
    corners = np.arange(3)[:, None] * m - np.arange(3) * n
    k, weight = _lags(corners, m, n)
    h = np.abs(k[:, None, None] - corners) * dt
    R = np.stack(
        [np.einsum("kab,a,b->k", part(h), _SECOND_DIFFERENCE, _SECOND_DIFFERENCE) for part in _NOISE_MODELS]
    )
    count, pairs = _lag_counts(k, lengths, m, n)
    return np.asarray(
        2 * (R * (weight * count)) @ R.T / pairs / (4 * (m * dt) ** 2 * (n * dt) ** 2), np.float64
    )


def _lags(corners: I64, m: int, n: int) -> tuple[I64, F64]:
    """Return integer lags, dense where the covariance has corners, and how many lags each stands for."""
    reach, near = 2 * (m + n), 2 * min(m, n)
    corner_lags = corners.reshape(-1, 1) + np.linspace(-near, near, _CORNER_LAGS)
    wide_lags = m - n + np.linspace(-reach, reach, _WIDE_LAGS)
    k = np.unique(np.rint(np.concatenate([corner_lags.ravel(), wide_lags])).astype(np.int64))
    gaps = np.diff(k, prepend=k[0] - 1, append=k[-1] + 1)
    return k, (gaps[1:] + gaps[:-1]) / 2


def _lag_counts(k: I64, lengths: I64, m: int, n: int) -> tuple[F64, float]:
    """Return how often each lag occurs over all segments, and the product of the numbers of differences."""
    of_m, of_n = np.maximum(lengths + 1 - 2 * m, 0), np.maximum(lengths + 1 - 2 * n, 0)
    lag = k[:, None]
    count = np.clip(np.minimum(of_m, of_n - lag) - np.maximum(0, -lag), 0, None).sum(axis=1)
    return count.astype(np.float64), float(of_m.sum()) * float(of_n.sum())
