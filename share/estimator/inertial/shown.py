"""How far the body has moved since the keyframe that others were told of last, as it is known by now.

What was told of that keyframe has been corrected since: at first mostly its tilt, by degrees. The difference
of what was told would have that as a turn of the body.
"""

from __future__ import annotations

import numpy as np

from share.estimator.inertial import ekf
from share.estimator.inertial.state import State
from share.geometry import se3
from share.types import F64

_FOUND_COV = np.diag(np.repeat([0.01**2, 0.03**2], 3))  # rad, m: of a place found again by its ORB features


class Shown:
    """The keyframe that others were told of last: its id; -1 where the filter has none."""

    def __init__(self) -> None:
        self.keyframe, self._T_odom_body = -1, np.eye(4)

    def forget(self) -> None:
        """The filter's keyframes are numbered anew."""
        self.keyframe = -1

    def told(self, s: State, keyframe: int) -> None:
        """The one with this id is the last one from now on: others have it."""
        self.keyframe, self._T_odom_body = keyframe, s.poses[ekf.number_of(s, keyframe)]

    def motion(self, s: State, k: int, new_stretch: bool) -> tuple[F64, F64]:
        """T_last_body (4, 4) of keyframe number k and its covariance (6, 6): as the state knows both now.
        Where it has the last one no longer, after a loss, as they were told, and as unsure as the place where
        the body was found again."""
        known = np.flatnonzero(s.keyframes[:k] == self.keyframe)
        if new_stretch:
            return s.poses[k], ekf.keyframe_cov(s, k)
        if len(known):
            return ekf.motion(s, int(known[0]), k), ekf.motion_cov(s, int(known[0]), k)
        return se3.inverse(self._T_odom_body) @ s.poses[k], ekf.keyframe_cov(s, k) + _FOUND_COV
