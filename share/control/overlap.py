"""How much two views have in common, from their poses alone: frusta on a grid of points.

The grid belongs to the frustum and moves with the camera: points ((i + 1/2) delta, (j + 1/2) delta) in layers
of equal depth, delta or a little less, from near to far; those that lie in the frustum count, each for an
equal part of its volume. V_overlap is the mean of what a's points in b tell, and b's points in a. So
overlap(a, b) = overlap(b, a), a frustum overlaps itself wholly, and the world's origin does not matter.
Source: SHARE, IMWUT 10(3) 97, 2026, which leaves the grid open.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from share.config import ControlConfig
from share.errors import ConfigError
from share.geometry.se3 import inverse
from share.types import F64, I64

_MOST_POINTS = 2_000_000  # before those outside are taken out
_SLACK_M = 1e-9  # a point on the border is inside, on whatever side rounding puts it


@dataclass(frozen=True)
class Frustum:
    """What a camera sees, in its frame: near_m <= z <= far_m; |x|, |y| up to tan(half the field of view) z.

    Raises ValueError if a field of view is not between 0 and pi, or not 0 <= near_m < far_m.
    """

    horizontal_rad: float
    vertical_rad: float
    near_m: float
    far_m: float

    def __post_init__(self) -> None:
        if not (0 < self.horizontal_rad < math.pi and 0 < self.vertical_rad < math.pi):
            raise ValueError("frustum: fields of view must be between 0 and pi")
        if not 0 <= self.near_m < self.far_m:
            raise ValueError(f"frustum: from {self.near_m} to {self.far_m} m is no depth")

    @property
    def slopes(self) -> tuple[float, float]:
        """Most of |x| / z and of |y| / z."""
        return math.tan(self.horizontal_rad / 2), math.tan(self.vertical_rad / 2)

    @property
    def volume(self) -> float:
        """m^3."""
        sx, sy = self.slopes
        return 4 / 3 * sx * sy * (self.far_m**3 - self.near_m**3)

    @property
    def planes(self) -> F64:
        """(6, 4): a point p (homogeneous) is inside where all of planes @ p, distances in m, are >= 0."""
        sx, sy = self.slopes
        sides = np.array([[-1, 0, sx, 0], [1, 0, sx, 0], [0, -1, sy, 0], [0, 1, sy, 0]])
        ends = np.array([[0, 0, 1, -self.near_m], [0, 0, -1, self.far_m]])
        return np.vstack([sides / np.linalg.norm(sides, axis=1, keepdims=True), ends])

    @property
    def sphere(self) -> tuple[float, float]:
        """z of the centre and radius of the least sphere around it, m."""
        sx, sy = self.slopes
        square = 1 + sx**2 + sy**2
        z = min(self.far_m, square * (self.far_m + self.near_m) / 2)
        return z, math.hypot(self.far_m * sx, self.far_m * sy, self.far_m - z)


class Overlap:
    """Between views with one frustum, sampled `interval_m` apart. Poses are T_w_cam, z forward, in one frame.

    Raises ValueError if the interval is so wide that no point lies in the frustum, or so narrow that there
    would be more than two million.
    """

    def __init__(self, frustum: Frustum, interval_m: float) -> None:
        self.frustum = frustum
        self._planes = frustum.planes
        self._points = _grid(frustum, interval_m)
        self._centre, self._radius = frustum.sphere

    @classmethod
    def of(cls, config: ControlConfig) -> Overlap:
        """As set. Raises ConfigError for what is no frustum or no grid."""
        fields = math.radians(config.horizontal_deg), math.radians(config.vertical_deg)
        try:
            return cls(Frustum(*fields, config.near_m, config.far_m), config.interval_m)
        except ValueError as error:
            raise ConfigError(f"control: {error}") from None

    @property
    def points(self) -> int:
        """Of the grid."""
        return len(self._points.T)

    def volumes(self, T_w_cam: F64, others: F64) -> F64:
        """V_overlap, m^3, of one view (4, 4) with each of others (N, 4, 4): (N,)."""
        return self.frustum.volume * self._shares(T_w_cam, others)

    def iou(self, T_w_cam: F64, others: F64) -> F64:
        """V_overlap / V_union, 0 to 1, of one view (4, 4) with each of others (N, 4, 4): (N,)."""
        shared = self._shares(T_w_cam, others)
        iou: F64 = shared / (2 - shared)
        return iou

    def _shares(self, T_w_cam: F64, others: F64) -> F64:
        """Parts of a frustum that lie in the other (N,)."""
        out = np.zeros(len(others))
        away = (others - T_w_cam) @ [0.0, 0.0, self._centre, 1.0]
        (near,) = np.nonzero((away**2).sum(-1) < (2 * self._radius) ** 2)
        if len(near):
            T_other_cam = inverse(others[near]) @ T_w_cam
            inside = self._inside(T_other_cam) + self._inside(inverse(T_other_cam))
            out[near] = inside / (2 * self.points)
        return out

    def _inside(self, T_b_a: F64) -> I64:
        """How many of a's points lie in b (N,)."""
        distances = (self._planes @ T_b_a) @ self._points
        count: I64 = (distances.min(axis=1) >= -_SLACK_M).sum(axis=-1)
        return count


def _grid(frustum: Frustum, interval_m: float) -> F64:
    """Homogeneous points (4, M)."""
    depth = frustum.far_m - frustum.near_m
    sizes = np.array([s * frustum.far_m for s in frustum.slopes] + [depth])
    if not (interval_m > 0 and 4 * np.prod(sizes / interval_m + 1) <= _MOST_POINTS):
        raise ValueError(f"overlap: points {interval_m} m apart are too many")
    across_x, across_y, layers = np.ceil(sizes / interval_m).astype(int)
    x, y = ((np.arange(-n, n) + 0.5) * interval_m for n in (across_x, across_y))
    z = frustum.near_m + (np.arange(layers) + 0.5) * depth / layers
    grid = np.stack(np.meshgrid(x, y, z), axis=-1).reshape(-1, 3)
    points = np.vstack([grid.T, np.ones(len(grid))])
    points = points[:, (frustum.planes @ points >= -_SLACK_M).all(axis=0)]
    if not points.shape[1]:
        raise ValueError(f"overlap: points {interval_m} m apart miss the frustum")
    return points
