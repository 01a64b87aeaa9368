"""Where in odom the body is told to be when the filter learns what is up.

At rest, a tilt and a bias of the accelerometer cannot be told apart; only turning and speeding up part
them. When that comes, the filter turns all it knows about the place where it began: nothing has moved, but
a body that has gone 5 m since would be told to jump by 9 cm a degree. So poses are told as if it had turned
about the body: up is right at once, and the body stays where it was. What a pose is relative to any other
that the filter holds is not touched.
"""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.odometry.state import FilterState
from share.types import F64

_Z_AXIS = 2


class TiltRealignment:
    """shift (3,) m: added to the filter's positions, whatever its keyframes are by now."""

    def __init__(self) -> None:
        self.offset = np.zeros(3)
        self._pivot_position = np.zeros(3)
        self._keyframe_ids, self._rotations = np.zeros(0, np.int64), np.zeros((0, 3, 3))

    def start(self, s: FilterState, pivot_position: F64, new_segment: bool) -> None:
        """Poses are told from `s` on, by a filter that began at `pivot_position` (3,). anew: so does odom."""
        self.offset = np.zeros(3) if new_segment else self.offset
        self._pivot_position = pivot_position
        self._store_rotations(s)

    def update(self, s: FilterState) -> None:
        """Whatever has been learnt since the last call."""
        R, before = s.keyframe_poses[:, :3, :3], self._rotations
        if not np.array_equal(self._keyframe_ids, s.keyframe_ids):
            _, old_rows, new_rows = np.intersect1d(self._keyframe_ids, s.keyframe_ids, return_indices=True)
            R, before = R[new_rows], before[old_rows]
        if len(R):
            turned = _small_rotation((R @ before.swapaxes(1, 2)).mean(axis=0))
            turned[_Z_AXIS] = 0.0  # about the vertical nothing is ever learnt; what turns keeps its place
            arm = s.T[:3, 3] - self._pivot_position
            self.offset = self.offset - (arm - se3.so3_exp(-turned) @ arm)
        self._store_rotations(s)

    def published_pose(self, T: F64) -> F64:
        """T_odom_body (4, 4), as others are told it, of a pose by the filter."""
        out = T.copy()
        out[:3, 3] += self.offset
        return out

    def _store_rotations(self, s: FilterState) -> None:
        self._keyframe_ids, self._rotations = s.keyframe_ids, s.keyframe_poses[:, :3, :3]


def _small_rotation(R: F64) -> F64:
    """rad (3,) of a rotation R (3, 3) by less than a right angle: half of what R - R' has is its sine."""
    sines = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine = float(np.linalg.norm(sines))
    return sines * (np.arcsin(min(sine, 1.0)) / sine) if sine > 1e-9 else sines
