"""What a tracker says of its own error: its covariances, summed up over the window of an error."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from share.geometry.se3 import compose_cov
from share.metrics.local_error import WINDOW_S
from share.types import F64, Candidate


class Doubt:
    """Of one agent, keyframe by keyframe."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_ns = round(window_s * 1e9)
        self._motions: deque[tuple[int, F64, F64]] = deque()  # when, T_last_this, its covariance

    def after(self, stamp_ns: int, candidate: Candidate) -> float:
        """cm, one sigma of how the position may be off after the motion of the last `window_s`."""
        if candidate.new_stretch:
            self._motions.clear()
        else:
            self._motions.append((stamp_ns, candidate.T_last_body, candidate.cov))
        while self._motions and self._motions[0][0] <= stamp_ns - self._window_ns:
            self._motions.popleft()
        cov = np.zeros((6, 6))
        for _, T, more in self._motions:
            cov = compose_cov(T, cov, more)
        return 100 * math.sqrt(max(0.0, float(np.trace(cov[3:, 3:]))))
