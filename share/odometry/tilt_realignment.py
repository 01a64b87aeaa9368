"""Keep published poses continuous when the filter's tilt estimate improves.

At rest, a tilt and an accelerometer bias cannot be distinguished; rotation and acceleration separate them.
Then the filter rotates all it has estimated about the place where it began, and a wearer would see the room
tilt. So odom keeps the tilt that it began with, and turns upright at an imperceptible speed. The up
direction that keyframes carry is the filter's. Poses relative to others in the filter are not affected.
"""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.odometry.state import FilterState
from share.types import F64

_UPRIGHT_RAD_S = np.radians(0.003)  # speed at which odom turns upright, about the body


class TiltRealignment:
    """T_odom_filter (4, 4): pose of the filter's frame, whose z axis is up as estimated now, in odom."""

    def __init__(self) -> None:
        self.T_odom_filter, self._T_odom_start = np.eye(4), np.eye(4)
        self._T_start_origin, self._stamp_ns = np.eye(4), 0

    def start(self, s: FilterState, new_segment: bool) -> None:
        """Begin with the state `s`, whose frame now is the start. new_segment: odom begins too."""
        self.T_odom_filter = self._T_odom_start = np.eye(4) if new_segment else self.T_odom_filter
        self._T_start_origin, self._stamp_ns = s.T_origin, s.stamp_ns

    def update(self, s: FilterState) -> None:
        """Compensate the tilt of the origin that the filter has changed since the start; turn odom a little
        upright."""
        T_start_filter = self._T_start_origin @ se3.inverse(s.T_origin)
        self.T_odom_filter = self._T_odom_start @ T_start_filter
        remaining = _small_rotation(self.T_odom_filter[:3, :3])
        angle = float(np.linalg.norm(remaining))
        if angle:
            step_rad = _UPRIGHT_RAD_S * 1e-9 * (s.stamp_ns - self._stamp_ns)
            body = self.published_pose(s.T)[:3, 3]
            turn = _rotation_about(body, -remaining * min(step_rad / angle, 1.0))
            self._T_odom_start = turn @ self._T_odom_start
            self.T_odom_filter = turn @ self.T_odom_filter
        self._stamp_ns = s.stamp_ns

    def published_pose(self, T: F64) -> F64:
        """Return T_odom_body (4, 4) to publish for a pose of the filter."""
        out: F64 = self.T_odom_filter @ T
        return out


def _rotation_about(position: F64, rotation: F64) -> F64:
    """Return the motion (4, 4) that rotates by `rotation` (3,) rad about a position (3,)."""
    R = se3.so3_exp(rotation)
    return se3.from_rt(R, position - R @ position)


def _small_rotation(R: F64) -> F64:
    """Return the rotation vector (3,) rad of R (3, 3), less than a right angle: (R - R') / 2 holds its
    sine."""
    sines = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine = float(np.linalg.norm(sines))
    return sines * (np.arcsin(min(sine, 1.0)) / sine) if sine > 1e-9 else sines
