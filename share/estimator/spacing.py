"""When a frame is far enough from the newest keyframe to be the next one."""

from __future__ import annotations

import numpy as np

from share.types import F64


class Spacing:
    """From the newest keyframe of one tracker, by poses (4, 4) of its body or of its camera.

    gap_s: s, sooner there is none; m, rad: after so much motion; left: or with less than this part in view
    of the features that the newest had.
    """

    def __init__(self, gap_s: float, m: float, rad: float, left: float) -> None:
        self._gap_ns, self._m, self._left = gap_s * 1e9, m, left
        self._least_cosine = np.cos(min(rad, np.pi))
        self.stamp_ns = self.features = 0  # of the newest
        self.T = np.eye(4)

    def wanted(self, stamp_ns: int, T: F64, seen: int) -> bool:
        """Whether a frame with so many features seen is to be one: moved, turned, or little left in view."""
        if stamp_ns - self.stamp_ns < self._gap_ns:
            return False
        cosine = ((self.T[:3, :3] * T[:3, :3]).sum() - 1) / 2  # of the angle between the two
        return bool(
            np.linalg.norm(T[:3, 3] - self.T[:3, 3]) > self._m
            or cosine < self._least_cosine
            or seen < self._left * self.features
        )
