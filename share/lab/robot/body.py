"""The true path of the robot's camera and IMU, which grows as the robot drives.

It is a uniform quintic B-spline whose control points are the body's poses each STEP_S: C4 as the emulator's
other paths, so what the IMU feels is exact; and local, so that a piece once driven never changes. A pose
depends on control points up to LOOK_AHEAD_NS later, which a drive's latency leaves known.
"""

from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.lab.emulate.motion.robot import PITCH_PER_ACCEL, base_shake, rumble_displacement
from share.lab.emulate.motion.spline import SPLINE_DEGREE, SplinePath, continuous_quaternions
from share.lab.emulate.motion.walk import axis_rotation
from share.lab.emulate.types import START_NS
from share.lab.robot.drive import STEP_NS, STEP_S, DriveStep
from share.types import F64

LOOK_AHEAD_NS = 3 * STEP_NS
_VIBRATION_M_S2 = 0.4  # as the emulator's `robot:`
_BEFORE = 2  # control points before time 0


class BodyPath:
    """The path of a body mounted at T_base_body (4, 4) on a base. seconds: the longest drive, for which the
    floor's rumble is drawn. Control point k is the pose at (k - _BEFORE) STEP_S."""

    def __init__(self, T_base_body: F64, seconds: float, rng: np.random.Generator) -> None:
        self._T_base_body = T_base_body
        count = int(seconds / STEP_S) + 100
        self._rumble = np.stack([rumble_displacement(count, rng) for _ in range(4)])
        self._points = np.empty((count, 7))  # position, quaternion
        self._count = 0  # of points
        self._added: list[DriveStep] = []  # of which there are no points yet: they are made together

    def add(self, step: DriveStep) -> None:
        """Add the base after its next step; first at time 0, before which it is at rest."""
        is_first = not self._count and not self._added
        self._added += [step] * (1 + _BEFORE if is_first else 1)

    def _make_points(self) -> None:
        first, last = self._count, self._count + len(self._added)
        poses = [step.T_world_base for step in self._added]
        x, y, yaw = np.array([(T.x, T.y, T.yaw) for T in poses]).T
        speed, acceleration = np.array([(s.speed_m_s, s.acceleration_m_s2) for s in self._added]).T
        up, aside, pitch, roll = base_shake(speed, _VIBRATION_M_S2, self._rumble[:, first:last])
        nose = pitch + PITCH_PER_ACCEL * np.clip(acceleration, -2.0, 2.0)
        R = axis_rotation(2, yaw) @ axis_rotation(1, -nose) @ axis_rotation(0, roll)
        shaken = np.stack([np.zeros_like(up), aside, up], axis=1)
        p = np.stack([x, y, np.zeros_like(x)], axis=1) + np.einsum("nij,nj->ni", R, shaken)
        T_world_body = se3.from_rt(R, p) @ self._T_base_body
        self._points[first:last, :3] = T_world_body[:, :3, 3]
        self._points[first:last, 3:] = se3.quat_from_matrix(T_world_body[:, :3, :3])
        signed = continuous_quaternions(self._points[max(first - 1, 0) : last, 3:])
        self._points[first:last, 3:] = signed[-len(self._added) :]
        self._count, self._added = last, []

    @property
    def known_until_ns(self) -> int:
        """Session time until which the path is known."""
        return (self._count + len(self._added) - 1 - _BEFORE) * STEP_NS - LOOK_AHEAD_NS

    def part(self, first_ns: int, last_ns: int) -> SplinePath:
        """Return the path from one session time to another, or a little more. Raises ValueError where it is
        not known."""
        if not 0 <= first_ns <= last_ns <= self.known_until_ns:
            raise ValueError(f"{first_ns} .. {last_ns} ns: the path is known until {self.known_until_ns} ns")
        from scipy.interpolate import BSpline

        if self._added:
            self._make_points()
        # control point k is the middle of its B-spline, which spans three steps to both sides
        first, last = first_ns // STEP_NS, last_ns // STEP_NS + 6
        points = self._points[first : last + 1]
        knots = STEP_S * (np.arange(len(points) + SPLINE_DEGREE + 1) - SPLINE_DEGREE)
        start_ns = START_NS + first * STEP_NS
        return SplinePath(
            start_ns,
            start_ns + (len(points) - SPLINE_DEGREE) * STEP_NS,
            BSpline(knots, points[:, :3], SPLINE_DEGREE),
            BSpline(knots, points[:, 3:], SPLINE_DEGREE),
        )
