"""Which samples of an IMU are measurements, and not glitches of its electronics or of its link."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.types import F64, I64

_NEIGHBOURS = 2  # neighbours either side
_MAX_SPIKE_SAMPLES = 3  # a glitch lasts at most so many samples
_MAX_SPIKE_NS = 12_000_000  # and at most so long: 10 ms and the jitter of stamps
_MAX_NEIGHBOUR_DISTANCE = (
    _MAX_SPIKE_SAMPLES + _NEIGHBOURS
)  # a neighbour is no further off: a run may lie between
_HISTORY_SAMPLES = (
    _MAX_SPIKE_SAMPLES - 1 + _MAX_NEIGHBOUR_DISTANCE
)  # of the frame before: a run that goes on, and its neighbours
_MAX_STEP_NS = 25_000_000  # samples further apart than this say nothing of each other
_REFERENCE_STEP_NS = 5_000_000  # bounds are of samples so far apart, 200 Hz, and grow with the distance
# Left out is a run each sample of which stands out from all of its neighbours by more than so many times what
# these differ, and this much more (rad/s, m/s^2). Of 195,000 samples of seven drones and hand-held recordings
# (EuRoC, TUM-VI), one, two or three in a row, none exceeds 0.13 and 4.0 with neighbours on both sides, 0.8
# and 13 with those before it alone.
_BOUNDS_BETWEEN = (4.0, np.repeat([1.0, 20.0], 3))
_BOUNDS_AT_END = (8.0, np.repeat([3.0, 50.0], 3))


@dataclass(frozen=True)
class ImuRange:
    """What a sensor can measure on each axis: rad/s, m/s^2. Default: the widest usual, 2000 deg/s and 18 g,
    and 5 % for its scale."""

    gyro: float = 36.7
    accel: float = 185.0


class ImuCheck:
    """Fed with the samples of each frame in turn. Counts what is left out: `out_of_range` (NaN too) and
    `spikes`, samples in runs of at most three that are far from those on both sides; a step, a shock or a
    vibration has neighbours that differ too. A run that ends with its frame is held against those before it,
    so that nothing waits for the next. One that goes on in the next frame is judged there as a whole: what of
    it was handed out stays so, the rest is left out."""

    def __init__(self, limits: ImuRange) -> None:
        self._limits = np.repeat([limits.gyro, limits.accel], 3)
        # the newest in range, and which of them are left out
        self._stamps, self._values, self._spike_history = (
            np.zeros(0, np.int64),
            np.zeros((0, 6)),
            np.zeros(0, np.bool_),
        )
        self.out_of_range = self.spikes = 0

    def valid_mask(self, stamps: I64, values: F64) -> NDArray[np.bool_]:
        """Of samples (N,) ns, (N, 6) gyro and accel: which (N,) are measurements."""
        valid = np.asarray((np.abs(values) <= self._limits).all(axis=1), np.bool_)  # NaN is not
        self.out_of_range += len(valid) - int(valid.sum())
        all_stamps, all_values = (
            np.concatenate([self._stamps, stamps[valid]]),
            np.concatenate([self._values, values[valid]]),
        )
        out = _spike_mask(all_stamps, all_values, self._spike_history)
        spikes = out[len(self._spike_history) :]
        self._stamps, self._values, self._spike_history = (
            all_stamps[-_HISTORY_SAMPLES:],
            all_values[-_HISTORY_SAMPLES:],
            out[-_HISTORY_SAMPLES:],
        )
        if spikes.any():
            self.spikes += int(spikes.sum())
            valid[np.flatnonzero(valid)[spikes]] = False
        return valid


def _spike_mask(stamps: I64, values: F64, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which (N,) stand out; of the first, `known` says it and is not changed."""
    count, new = len(stamps), len(known)
    out = np.concatenate([known, np.zeros(count - new, np.bool_)])
    # cheap first: a run that stands out begins with a leap, and another one ends it
    leaps = np.zeros(count + 1, np.bool_)
    leaps[1:count] = (np.abs(np.diff(values, axis=0)) > _BOUNDS_BETWEEN[1]).any(axis=1)
    leaps[count] = True  # may be one
    for leap in np.flatnonzero(leaps[:count]).tolist():
        first = leap
        while first and out[first - 1]:  # it goes on with a run
            first -= 1
        for past in range(max(leap, new) + 1, min(first + _MAX_SPIKE_SAMPLES, count) + 1):
            if leaps[past] and _is_spike(stamps, values, out, first, past):
                out[max(leap, new) : past] = True
                break
    return out


def _is_spike(stamps: I64, values: F64, out: NDArray[np.bool_], first: int, past: int) -> bool:
    """Whether each sample of the run [first, past) does."""
    around = [k for k in range(first - 1, max(-1, first - 1 - _MAX_NEIGHBOUR_DISTANCE), -1) if not out[k]][
        :_NEIGHBOURS
    ]
    if len(around) < _NEIGHBOURS or stamps[past - 1] - stamps[first] > _MAX_SPIKE_NS:
        return False
    after = list(range(past, min(past + _NEIGHBOURS, len(stamps))))
    factor, margin = _BOUNDS_BETWEEN if after else _BOUNDS_AT_END
    near, run = values[[*around, *after]], values[first:past]
    low, high = near.min(axis=0), near.max(axis=0)
    excess = np.maximum(run - high, low - run) - factor * (high - low)
    if not (excess > margin).any(axis=1).all():
        return False
    steps = np.diff(stamps[[*around[::-1], *range(first, past), *after]])
    step_factor = max(1.0, float(np.median(steps)) / _REFERENCE_STEP_NS)
    return bool(steps.max() <= _MAX_STEP_NS and (excess > step_factor * margin).any(axis=1).all())
