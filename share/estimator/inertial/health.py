"""Whether images and IMU tell of one and the same motion."""

from __future__ import annotations

import numpy as np

from share.types import F64

_OVER_S, _LEAST_S = 5.0, 1.0  # averaged over; of frames, before anything is said
_BEGIN_S = 1.0  # in which a filter that has just begun finds its bearings
_FEWEST = 25  # features that say something
_SURPRISED = 0.8  # of the median squared Mahalanobis distance, which is 0.05 to 0.6 where all is well


class Agreement:
    """A camera that is turned or shifted against its calibration, or whose clock is off, is tracked all the
    same, a little beside where the IMU says, all features alike, frame after frame: none is refused for it.
    With 5 degrees and 5 cm the median rises to 1.2 to 3 (docs/vio.md)."""

    def __init__(self) -> None:
        self._mean, self._seconds = 0.0, 0.0

    def add(self, surprise: F64, seconds: float) -> None:
        """`ekf.surprise` (M,) of a frame's features, and how long it was since the frame before."""
        if len(surprise) < _FEWEST:
            return
        self._seconds += seconds
        heard = self._seconds - _BEGIN_S
        if heard <= 0:
            return
        share = min(seconds / min(heard, _OVER_S), 1.0)
        self._mean += share * (float(np.median(surprise)) - self._mean)

    @property
    def sound(self) -> bool:
        """False where they contradict each other."""
        return self._seconds < _BEGIN_S + _LEAST_S or self._mean < _SURPRISED
