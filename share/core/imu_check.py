"""Which samples of an IMU are measurements, and not glitches of its electronics or of its link."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.types import F64, I64

_AROUND = 2  # neighbours either side
_APART_NS = 25_000_000  # samples further apart than this say nothing of each other
_USUAL_NS = 5_000_000  # bounds are of samples so far apart, 200 Hz, and grow with the distance
# A sample that stands out from all of its neighbours by more than so many times what these differ, and this
# much more (rad/s, m/s^2). Of 195,000 samples of seven drones and hand-held recordings (EuRoC, TUM-VI) none
# exceeds 0.12 and 2.3 with neighbours on both sides, 0.8 and 13 with those before it alone.
_BETWEEN = (4.0, np.repeat([1.0, 20.0], 3))
_AT_THE_END = (8.0, np.repeat([3.0, 50.0], 3))


@dataclass(frozen=True)
class ImuRange:
    """What a sensor can measure on each axis: rad/s, m/s^2. Default: the widest usual, 2000 deg/s and 18 g,
    and 5 % for its scale."""

    gyro: float = 36.7
    accel: float = 185.0


class ImuCheck:
    """Fed with the samples of each frame in turn. Counts what is left out: `out_of_range` (NaN too) and
    `spikes`, single samples far from those around them; a step, a shock or a vibration has neighbours that
    differ too. The last of a frame is held against those before it, so that nothing waits for the next."""

    def __init__(self, limits: ImuRange) -> None:
        self._most = np.repeat([limits.gyro, limits.accel], 3)
        self._stamps, self._values = np.zeros(0, np.int64), np.zeros((0, 6))  # the newest in range
        self.out_of_range = self.spikes = 0

    def believed(self, stamps: I64, values: F64) -> NDArray[np.bool_]:
        """Of samples (N,) ns, (N, 6) gyro and accel: which (N,) are measurements."""
        good = np.asarray((np.abs(values) <= self._most).all(axis=1), np.bool_)  # NaN is not
        self.out_of_range += len(good) - int(good.sum())
        before = len(self._stamps)
        at, all_ = np.concatenate([self._stamps, stamps[good]]), np.concatenate([self._values, values[good]])
        spikes = _spikes(at, all_)[before:]
        self._stamps, self._values = at[-_AROUND:], all_[-_AROUND:]
        if spikes.any():
            self.spikes += int(spikes.sum())
            good[np.flatnonzero(good)[spikes]] = False
        return good


def _spikes(stamps: I64, values: F64) -> NDArray[np.bool_]:
    """Which (N,) stand out."""
    count = len(stamps)
    out = np.zeros(count, np.bool_)
    # cheap first: whoever does not leap from the one before it does not stand out
    leaps = np.zeros(count, np.bool_)
    leaps[1:] = (np.abs(np.diff(values, axis=0)) > _BETWEEN[1]).any(axis=1)
    for k in np.flatnonzero(leaps).tolist():
        first, last = max(0, k - _AROUND), min(count - 1, k + _AROUND)
        steps = np.diff(stamps[first : last + 1])
        if last - first >= _AROUND + (last > k) and steps.max() <= _APART_NS:
            around = np.delete(values[first : last + 1], k - first, axis=0)
            wider = max(1.0, float(np.median(steps)) / _USUAL_NS)
            out[k] = _stands_out(values[k], around, wider, ends=bool(last == k))
    return out


def _stands_out(value: F64, around: F64, wider: float, ends: bool) -> bool:
    times, more = _AT_THE_END if ends else _BETWEEN
    low, high = around.min(axis=0), around.max(axis=0)
    excess = np.maximum(value - high, low - value)
    return bool((excess > times * (high - low) + wider * more).any())
