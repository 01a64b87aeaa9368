"""Local error of odometry against the truth: the quantity that the error model estimates without truth.

The causal poses of the last seconds are aligned with the truth (SE3, positions only); the error is their
RMS. It measures present drift, not the drift accumulated since the start.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from share.geometry.interpolation import Trajectory, interpolate
from share.geometry.se3 import transform, umeyama
from share.types import F64

WINDOW_S = 5.0
_MIN_POSES = 10  # and they must span half the window


class LocalError:
    """Local error of one agent. truth: poses of its body at stamps of its clock."""

    def __init__(self, truth: Trajectory) -> None:
        self._truth, self._window_ns = truth, round(WINDOW_S * 1e9)
        self._window: deque[tuple[int, F64, F64]] = deque()  # stamp ns, estimated position, true position

    def update(self, stamp_ns: int, T_odom_body: F64 | None, new_segment: bool = False) -> float | None:
        """Add a frame; return the error in cm. None without a pose or truth, or with too few in the
        window."""
        if new_segment:
            self._window.clear()
        while self._window and self._window[0][0] < stamp_ns - self._window_ns:
            self._window.popleft()
        if T_odom_body is None:
            return None
        has_truth, T_truth = interpolate(*self._truth, np.array([stamp_ns]))
        if not has_truth[0]:
            return None
        self._window.append((stamp_ns, T_odom_body[:3, 3], T_truth[0, :3, 3]))
        if len(self._window) < _MIN_POSES or stamp_ns - self._window[0][0] < self._window_ns // 2:
            return None
        estimated, actual = (np.array([entry[i] for entry in self._window]) for i in (1, 2))
        residuals = transform(umeyama(estimated, actual), estimated) - actual
        return 100 * float(np.sqrt((residuals**2).sum(1).mean()))
