"""Find IMU samples that are glitches of the electronics or the link, not measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.types import F64, I64

_NEIGHBOURS = 2  # on each side
_MAX_SPIKE_SAMPLES = 3  # longest glitch, samples
_MAX_SPIKE_NS = 12_000_000  # longest glitch: 10 ms plus the jitter of stamps
# Search distance for neighbours, samples: another spike may lie between.
_MAX_NEIGHBOUR_DISTANCE = _MAX_SPIKE_SAMPLES + _NEIGHBOURS
# Samples kept from the previous frame: a spike that continues, and its neighbours.
_HISTORY_SAMPLES = _MAX_SPIKE_SAMPLES - 1 + _MAX_NEIGHBOUR_DISTANCE
_MAX_STEP_NS = 25_000_000  # samples further apart than this are not compared
_REFERENCE_STEP_NS = 5_000_000  # step for which the bounds hold (200 Hz); they grow with the step
# A spike is a run of samples that all differ from all of their neighbours by more than factor times the
# spread of the neighbours, plus margin (rad/s, m/s^2). Among 195,000 samples of seven drone and hand-held
# recordings (EuRoC, TUM-VI), in runs of one, two or three, the excess over factor times the spread was at
# most 0.13 and 4.0 with neighbours on both sides, 0.8 and 13 with neighbours before only.
_BOUNDS_BETWEEN = (4.0, np.repeat([1.0, 20.0], 3))  # factor, margin: neighbours on both sides
_BOUNDS_AT_END = (8.0, np.repeat([3.0, 50.0], 3))  # neighbours before only


@dataclass(frozen=True)
class ImuRange:
    """Measurement range per axis, rad/s and m/s^2.

    Default: the widest common ranges, 2000 deg/s and 18 g, plus 5 % for the scale.
    """

    gyro: float = 36.7
    accel: float = 185.0


class ImuCheck:
    """Rejects samples out of range and spikes, frame by frame; counts `out_of_range` (NaN too) and `spikes`.

    A spike is a run of at most three samples far from those on both sides. A step, a shock or a vibration is
    none: its neighbours differ as well. A run at the end of a frame is compared with the samples before it
    only, so that nothing waits for the next frame. If it continues there, the whole run is judged again:
    samples already passed stay passed, the rest is rejected.
    """

    def __init__(self, limits: ImuRange) -> None:
        self._limits = np.repeat([limits.gyro, limits.accel], 3)
        # the latest samples in range, and which of them are spikes
        self._stamps = np.zeros(0, np.int64)
        self._values = np.zeros((0, 6))
        self._spike_history = np.zeros(0, np.bool_)
        self.out_of_range = self.spikes = 0

    def valid_mask(self, stamps: I64, values: F64) -> NDArray[np.bool_]:
        """Return which (N,) samples are measurements. stamps (N,) ns, values (N, 6) gyro and accel."""
        valid = np.asarray((np.abs(values) <= self._limits).all(axis=1), np.bool_)  # False for NaN
        self.out_of_range += len(valid) - int(valid.sum())
        all_stamps = np.concatenate([self._stamps, stamps[valid]])
        all_values = np.concatenate([self._values, values[valid]])
        out = _spike_mask(all_stamps, all_values, self._spike_history)
        spikes = out[len(self._spike_history) :]
        self._stamps = all_stamps[-_HISTORY_SAMPLES:]
        self._values = all_values[-_HISTORY_SAMPLES:]
        self._spike_history = out[-_HISTORY_SAMPLES:]
        if spikes.any():
            self.spikes += int(spikes.sum())
            valid[np.flatnonzero(valid)[spikes]] = False
        return valid


def _spike_mask(stamps: I64, values: F64, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which samples (N,) are spikes. known: the result for the first of them, which is not changed."""
    count, new = len(stamps), len(known)
    out = np.concatenate([known, np.zeros(count - new, np.bool_)])
    # cheap test first: a spike begins with a leap, and another leap ends it
    leaps = np.zeros(count + 1, np.bool_)
    leaps[1:count] = (np.abs(np.diff(values, axis=0)) > _BOUNDS_BETWEEN[1]).any(axis=1)
    leaps[count] = True  # the next sample is unknown
    for leap in np.flatnonzero(leaps[:count]).tolist():
        first = leap
        while first and out[first - 1]:  # continues a spike
            first -= 1
        for past in range(max(leap, new) + 1, min(first + _MAX_SPIKE_SAMPLES, count) + 1):
            if leaps[past] and _is_spike(stamps, values, out, first, past):
                out[max(leap, new) : past] = True
                break
    return out


def _is_spike(stamps: I64, values: F64, out: NDArray[np.bool_], first: int, past: int) -> bool:
    """Return whether the run [first, past) is a spike. out (N,): earlier spikes, which are no neighbours."""
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
