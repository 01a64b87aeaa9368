"""Keep published positions continuous when the filter's tilt estimate improves.

At rest, a tilt and an accelerometer bias cannot be distinguished; rotation and acceleration separate them.
Then the filter rotates all it has estimated about the place where it began: the body has not moved, but at 5
m from there its position would jump by 9 cm per degree. So poses are published as if that rotation were about
the body: up is right at once, and the position follows at a speed that nobody notices, until it is the
filter's again. Poses relative to others in the filter are not affected.
"""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.odometry.state import FilterState
from share.types import F64

_Z_AXIS = 2
_RETURN_M_S = 0.01  # at which the published position returns to the filter's


class TiltRealignment:
    """offset (3,) m: added to the filter's positions."""

    def __init__(self) -> None:
        self.offset = np.zeros(3)
        self._pivot_position, self._stamp_ns = np.zeros(3), 0
        self._keyframe_ids, self._rotations = np.zeros(0, np.int64), np.zeros((0, 3, 3))

    def start(self, s: FilterState, pivot_position: F64, new_segment: bool) -> None:
        """Begin with the state `s` of a filter that began at `pivot_position` (3,). new_segment: odom
        begins too."""
        self.offset = np.zeros(3) if new_segment else self.offset
        self._pivot_position, self._stamp_ns = pivot_position, s.stamp_ns
        self._store_rotations(s)

    def update(self, s: FilterState) -> None:
        """Compensate the rotation since the last call, and return part of what is compensated."""
        R, before = s.keyframe_poses[:, :3, :3], self._rotations
        if not np.array_equal(self._keyframe_ids, s.keyframe_ids):
            _, old_rows, new_rows = np.intersect1d(self._keyframe_ids, s.keyframe_ids, return_indices=True)
            R, before = R[new_rows], before[old_rows]
        if len(R):
            turned = _small_rotation((R @ before.swapaxes(1, 2)).mean(axis=0))
            turned[_Z_AXIS] = 0.0  # heading is unobservable
            arm = s.T[:3, 3] - self._pivot_position
            self.offset = self.offset - (arm - se3.so3_exp(-turned) @ arm)
        length_m = float(np.linalg.norm(self.offset))
        step_m = _RETURN_M_S * 1e-9 * (s.stamp_ns - self._stamp_ns)
        self.offset = self.offset * (1.0 - min(step_m / length_m, 1.0) if length_m else 0.0)
        self._stamp_ns = s.stamp_ns
        self._store_rotations(s)

    def published_pose(self, T: F64) -> F64:
        """Return T_odom_body (4, 4) to publish for a pose of the filter."""
        out = T.copy()
        out[:3, 3] += self.offset
        return out

    def _store_rotations(self, s: FilterState) -> None:
        self._keyframe_ids, self._rotations = s.keyframe_ids, s.keyframe_poses[:, :3, :3]


def _small_rotation(R: F64) -> F64:
    """Return the rotation vector (3,) rad of R (3, 3), less than a right angle: (R - R') / 2 holds its
    sine."""
    sines = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine = float(np.linalg.norm(sines))
    return sines * (np.arcsin(min(sine, 1.0)) / sine) if sine > 1e-9 else sines
