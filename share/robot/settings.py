"""Settings of a robot bridge: camera extrinsics, speed, accuracy, and the area in which it may drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from share.robot.planar import PlanarPose
from share.types import F64

CREATE3_SPEED_M_S = 0.306  # a Create 3's own limit


@dataclass(frozen=True)
class DrivingArea:
    """corners: (x, y) in m, in order, three or more. map_id: the map in which they are meant; None: the first
    one that the bridge sees."""

    corners: tuple[tuple[float, float], ...]
    map_id: str | None = None

    def contains(self, pose: PlanarPose) -> bool:
        """Return whether a position lies within the polygon: a ray from it crosses an odd number of edges."""
        inside = False
        for (ax, ay), (bx, by) in zip(self.corners, _rotated(self.corners), strict=True):
            if (ay > pose.y) != (by > pose.y) and pose.x < ax + (pose.y - ay) / (by - ay) * (bx - ax):
                inside = not inside
        return inside

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Least x and y, and greatest, m."""
        xs, ys = [x for x, _ in self.corners], [y for _, y in self.corners]
        return min(xs), min(ys), max(xs), max(ys)


def _rotated(corners: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    return [*corners[1:], corners[0]]


@dataclass(frozen=True, eq=False)
class RobotSettings:
    """T_body_base (4, 4): takes coordinates in base_link to the agent's body. allow_goals: whether the robot
    may move. max_sigma_m: a larger sigma of its position in the map stops the robot. edge_silence_s: longest
    time that a goal goes on without the edge. agent: source of the poses; None: the first that comes."""

    T_body_base: F64 = field(default_factory=lambda: np.eye(4))
    allow_goals: bool = False
    area: DrivingArea | None = None
    max_speed_m_s: float = 0.2
    max_sigma_m: float = 0.1
    edge_silence_s: float = 5.0
    agent: str | None = None
