"""Allan deviation of a sensor at rest, over stretches without gaps.

Source: IEEE Std 952-1997, annex C; the overlapping estimator of Howe, Allan and Barnes 1981 (NIST SP 1065,
5.2.4). What the curve tells: `share.calibration.noise`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from share.errors import DataError
from share.types import F64, I64

_LEAST_SAMPLES = 100
_OVERLAP = 16


@dataclass(frozen=True, eq=False)
class AllanCurve:
    """sizes (T,): samples in an average; deviation (T, A) in the unit of the samples, A axes.
    lengths (S,): samples of each stretch; rate_hz of the samples."""

    sizes: I64
    deviation: F64
    lengths: I64
    rate_hz: float

    @property
    def taus(self) -> F64:
        """(T,) s that an average lasts."""
        return np.asarray(self.sizes / self.rate_hz, np.float64)

    @property
    def clusters(self) -> I64:
        """(T,) independent averages, side by side: in each stretch as many as fit, less those that have
        no neighbour."""
        fit = self.lengths // self.sizes[:, None]
        return np.asarray(np.where(fit >= 2, fit, 0).sum(axis=1), np.int64)


def allan_deviation(samples: F64 | Sequence[F64], rate_hz: float, per_octave: int = 4) -> AllanCurve:
    """Of samples (N, A) at `rate_hz`, or of several stretches of them with gaps between: no difference is
    taken across a gap. Over averages of one sample up to a quarter of the longest stretch.

    Raises DataError where no stretch has 100 samples, or for values that are not finite.
    """
    given = [samples] if isinstance(samples, np.ndarray) else samples
    stretches = [np.asarray(one, np.float64) for one in given if len(one) >= 2]
    longest = max(map(len, stretches), default=0)
    if longest < _LEAST_SAMPLES:
        raise DataError(f"Allan deviation: {longest} samples in a row, needs {_LEAST_SAMPLES}; record longer")
    if not all(np.isfinite(s).all() for s in stretches):
        raise DataError("Allan deviation: has samples that are not finite")
    octaves = np.log2(longest / 4)
    sizes = np.unique(np.rint(2 ** np.linspace(0, octaves, int(octaves * per_octave) + 1)).astype(np.int64))
    total = np.sum([_squares(_summed(one), sizes) for one in stretches], axis=0)
    return AllanCurve(
        sizes=sizes,
        deviation=np.sqrt(total[:, :-1] / total[:, -1:] / 2) / sizes[:, None],
        lengths=np.array([len(s) for s in stretches], np.int64),
        rate_hz=rate_hz,
    )


def _summed(samples: F64) -> F64:
    """Running sum (N + 1, A) of samples (N, A) less their mean, which tells nothing."""
    sums = np.cumsum(samples - samples.mean(axis=0), axis=0)
    return np.concatenate([np.zeros((1, samples.shape[1])), sums])


def _squares(theta: F64, sizes: I64) -> F64:
    """(T, A + 1): sum of squared second differences of the running sum at each size, and their number."""
    out = np.zeros((len(sizes), theta.shape[1] + 1))
    for row, m in zip(out, sizes, strict=True):
        if 2 * m < len(theta):
            step = max(1, m // _OVERLAP)  # starts closer than that tell nothing new
            second = theta[2 * m :: step] - 2 * theta[m:-m:step] + theta[: -2 * m : step]
            row[:-1], row[-1] = (second**2).sum(axis=0), len(second)
    return out
