"""Poses on the floor: x, y and yaw, as a robot's odometry and navigation have them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from share.types import F64


@dataclass(frozen=True)
class PlanarPose:
    """A rigid transform in the plane. x, y: m. yaw: rad, counterclockwise."""

    x: float
    y: float
    yaw: float

    def __matmul__(self, other: PlanarPose) -> PlanarPose:
        """T_a_c = T_a_b @ T_b_c."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        x, y = self.x + c * other.x - s * other.y, self.y + s * other.x + c * other.y
        return PlanarPose(x, y, wrapped(self.yaw + other.yaw))

    def inverse(self) -> PlanarPose:
        """T_b_a of T_a_b."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return PlanarPose(-c * self.x - s * self.y, s * self.x - c * self.y, -self.yaw)

    def distance_m(self, other: PlanarPose) -> float:
        """Return the distance of the two positions, m."""
        return math.hypot(self.x - other.x, self.y - other.y)

    @property
    def is_finite(self) -> bool:
        return math.isfinite(self.x) and math.isfinite(self.y) and math.isfinite(self.yaw)


def wrapped(angle: float) -> float:
    """Return an angle, rad, in -pi … pi."""
    return math.remainder(angle, 2 * math.pi)


def flattened(T: F64) -> PlanarPose:
    """Return a pose (4, 4) in a z-up frame without its height and tilt. yaw: heading of its x axis."""
    return PlanarPose(float(T[0, 3]), float(T[1, 3]), math.atan2(float(T[1, 0]), float(T[0, 0])))


def between(a: PlanarPose, b: PlanarPose, u: float) -> PlanarPose:
    """Return the pose at the fraction u, 0 to 1, of the way from a to b."""
    return PlanarPose(
        a.x + u * (b.x - a.x), a.y + u * (b.y - a.y), wrapped(a.yaw + u * wrapped(b.yaw - a.yaw))
    )


def yaw_of_quaternion(x: float, y: float, z: float, w: float) -> float:
    """Return the heading, rad, of the x axis of a frame with this rotation."""
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
