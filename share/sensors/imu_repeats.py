"""Find IMU samples that carry no measurement: an IMU, or its driver, that repeats the same values for ever.

A living IMU is noisy in six axes. Its samples may equal the one before by chance or because a driver asks
faster than the sensor measures, and that does no harm. A third equal one is none: it is dropped, and an IMU
that gives no other is silent. Six exact zeros are what an empty register reads.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from share.types import F64

_ALLOWED = 2  # equal samples in a row


class ImuRepeats:
    """Rejects repeated samples, frame by frame, and counts them."""

    def __init__(self) -> None:
        self.count = 0
        self._last = np.full((_ALLOWED, 6), np.nan)

    def valid_mask(self, values: F64) -> NDArray[np.bool_]:
        """Return which (N,) samples are measurements. values (N, 6): gyro and accel, in order of time."""
        all_values = np.concatenate([self._last, values])
        self._last = all_values[-_ALLOWED:]
        equals_before = (all_values[1:] == all_values[:-1]).all(axis=1)
        repeated = equals_before[1:] & equals_before[:-1]
        repeated |= (values == 0).all(axis=1)
        self.count += int(repeated.sum())
        out: NDArray[np.bool_] = ~repeated
        return out
