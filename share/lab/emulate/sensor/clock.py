"""Sampling times of a device's streams, and the stamps of its clock.

True time is the path's, in ns: the time in which the motion happens. A picture's time is the middle of its
exposure. Random numbers are drawn by index: independent of the order and span of requests.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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


_MAX_BURST_FRAMES = 64
_MAX_JITTER_SHARE = 0.45  # of a period: largest stamp error that keeps the order


@dataclass(frozen=True)
class DeviceClock:
    """A clock that shows true time plus an offset and a drift since `origin_ns`, in ticks of tick_ns.

    bits: width of its counter, which wraps; 0: it does not wrap.
    """

    origin_ns: int = 0
    offset_ns: int = 0
    drift_ppm: float = 0.0
    tick_ns: int = 1
    bits: int = 0

    @property
    def period_ns(self) -> int:
        """Return the period after which the counter wraps; 0: never."""
        return self.tick_ns << self.bits if self.bits else 0

    def read(self, true_ns: I64) -> I64:
        """Return the clock's reading at true times (N,)."""
        since = true_ns - self.origin_ns
        clock_ns = true_ns + self.offset_ns + np.rint(since * (self.drift_ppm * 1e-6)).astype(np.int64)
        ticks = clock_ns // self.tick_ns
        if self.bits:
            ticks = ticks % (1 << self.bits)
        out: I64 = ticks * self.tick_ns
        return out


@dataclass(frozen=True)
class SampleStream:
    """Samples at `rate_hz`, the first at `first_ns` true time; indices do not depend on the span."""

    rate_hz: float
    first_ns: int

    def sample_times(self, start_ns: int, end_ns: int) -> tuple[I64, I64]:
        """Return (index, true_ns), each (N,), of the samples in [start, end], both included."""
        rate = self.rate_hz / 1e9
        low = max(0, int(np.ceil((start_ns - self.first_ns) * rate)) - 1)
        high = int(np.floor((end_ns - self.first_ns) * rate)) + 1
        index = np.arange(low, high + 1, dtype=np.int64)
        true = self.first_ns + np.rint(index / rate).astype(np.int64)
        inside = (true >= start_ns) & (true <= end_ns)
        return index[inside], true[inside]


def phase_ns(seed: Seed, rate_hz: float) -> int:
    """Return the start of a free-running stream within its first period, ns."""
    return int(np.random.default_rng(seed).random() * 1e9 / rate_hz)


def dropped_mask(seed: Seed, index: I64, share: float, burst: float) -> np.ndarray:
    """Return which frames (N,) bool are lost: `share` of them on average, in bursts of `burst` frames on
    average.

    A burst starts at each frame with equal probability and lasts a geometrically distributed number of
    frames, up to 64; bursts may overlap, so the start probability is reduced to match `share`.
    """
    if share <= 0 or len(index) == 0:
        return np.zeros(len(index), bool)
    reach = np.arange(_MAX_BURST_FRAMES)
    survival = (1 - 1 / burst) ** reach  # probability that a burst lasts longer than `reach` frames
    first = max(0, int(index.min()) - _MAX_BURST_FRAMES)
    frames = np.arange(first, int(index.max()) + 1)
    is_burst_start = uniform((*seed, 0), frames) < _start_probability(share, survival)
    lasts = uniform((*seed, 1), frames)
    is_dropped = is_burst_start.copy()
    for back in reach[1:][survival[1:] > 1e-9]:
        is_dropped[back:] |= is_burst_start[:-back] & (lasts[:-back] < survival[back])
    out: np.ndarray = is_dropped[index - first]
    return out


def _start_probability(share: float, survival: NDArray[Any]) -> float:
    """Return p with 1 - prod(1 - p s_i) = share, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(60):
        p = (low + high) / 2
        low, high = (p, high) if 1 - np.prod(1 - p * survival) < share else (low, p)
    return (low + high) / 2


def stamp_jitter_ns(seed: Seed, index: I64, sigma_ns: float, rate_hz: float) -> I64:
    """Return the error of each sample's stamp (N,) ns: normal, clipped at 3 sigma and so that stamps stay in
    order."""
    if sigma_ns <= 0:
        return np.zeros(len(index), np.int64)
    limit = min(3 * sigma_ns, _MAX_JITTER_SHARE * 1e9 / rate_hz)
    return np.rint(np.clip(normal(seed, index) * sigma_ns, -limit, limit)).astype(np.int64)
