"""Where a robot may drive: a polygon on the floor of one map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from share.robot.planar import PlanarPose


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
