"""The merge gate: skips merges with little view overlap compared with previous merges.

P_skip = max(0, 1 - alpha_m V_new / V), V the mean overlap of the last N completed merges. Source: SHARE,
IMWUT 10(3) 97, 2026, which leaves the sampling of the overlap open.

The overlap of two view frusta follows from poses and fields of view alone, by a grid fixed to the camera:
points ((i + 1/2) delta, (j + 1/2) delta) in layers of equal depth, delta or slightly less apart, from near to
far. Points inside the frustum count, each for an equal part of its volume. V_overlap is the mean of two
estimates, by a's points in b and by b's points in a, so it is symmetric, a frustum overlaps itself
completely, and the world's origin does not matter.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from share.config import NEAR_M, ControlConfig
from share.geometry.camera import Camera, Rig
from share.geometry.se3 import inverse
from share.scheduling.policies import POLICIES
from share.types import F64, I64

INTERVAL_M = 0.5  # spacing of the points at which overlap is sampled
_CACHED_CAMERAS = 64  # sampled frusta kept; agents have few kinds of camera
_MAX_FIELD_RAD = math.radians(160)  # a wider field of view is clipped: it is no pinhole
_MIN_SAMPLES, _MAX_SAMPLES = 3, 80  # points along half a side and along the depth, whatever the interval
_BORDER_TOLERANCE_M = 1e-9  # a point on the border counts as inside, in spite of rounding


class MergeGate:
    """The merge gate of one edge. It skips nothing if the policy has no gate."""

    def __init__(self, config: ControlConfig, policy: str) -> None:
        self._is_enabled = POLICIES[policy].has_merge_gate
        self._eagerness = config.eagerness  # alpha_m
        self._volumes: deque[float] = deque(maxlen=config.merges)  # of the last N completed merges, m^3
        self._rng = np.random.default_rng(config.random_seed)

        @lru_cache(_CACHED_CAMERAS)
        def sampled_frustum(camera: Camera) -> SampledFrustum:
            return SampledFrustum(Frustum.from_camera(camera, NEAR_M, config.far_m), INTERVAL_M)

        self._sampled_frustum = sampled_frustum

    def overlap_volume(self, a: Rig, b: Rig, T_a_b: F64) -> float:
        """Return the volume that cam0 of both agents see, m^3; 0 without a gate. T_a_b (4, 4): of their
        bodies."""
        if not self._is_enabled:
            return 0.0
        T_a_camb = T_a_b @ b.T_body_cam0
        return float(
            overlap_volumes(
                self._sampled_frustum(a.cam0), a.T_body_cam0, self._sampled_frustum(b.cam0), T_a_camb[None]
            )[0]
        )

    def skip_probability(self, volume: float, same_map: bool) -> float:
        """Return P_skip of a merge with this overlap, m^3. same_map: both sides are in one map already.

        0 between two maps, without completed merges, and without a gate.
        """
        total = sum(self._volumes)
        if not self._is_enabled or not same_map or total <= 0:
            return 0.0
        return max(0.0, 1 - self._eagerness * volume * len(self._volumes) / total)

    def skip_reason(self, volume: float, same_map: bool) -> str:
        """Return why a merge with this overlap is skipped, for a person; empty if it is not. Parameters as in
        `skip_probability`."""
        probability = self.skip_probability(volume, same_map)
        if self._is_enabled and self._rng.random() < probability:
            return f"small gain: views overlap by {volume:.1f} m³, skipped with probability {probability:.0%}"
        return ""

    def record_merge(self, volume: float) -> None:
        """Record a completed merge with this overlap, m^3."""
        self._volumes.append(volume)


@dataclass(frozen=True)
class Frustum:
    """View frustum in the camera frame: near_m <= z <= far_m, |x| and |y| up to tan(half field of view) z.

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
            raise ValueError(f"frustum: near {self.near_m} m must be at least 0 and below far {self.far_m} m")

    @classmethod
    def from_camera(cls, camera: Camera, near_m: float, far_m: float) -> Frustum:
        """Return the frustum by focal lengths and image size, ignoring principal point and distortion."""
        horizontal, vertical = camera.field_of_view_rad
        return cls(min(horizontal, _MAX_FIELD_RAD), min(vertical, _MAX_FIELD_RAD), near_m, far_m)

    @property
    def slopes(self) -> tuple[float, float]:
        """Largest |x| / z and |y| / z."""
        return math.tan(self.horizontal_rad / 2), math.tan(self.vertical_rad / 2)

    @property
    def volume(self) -> float:
        """m^3."""
        sx, sy = self.slopes
        return 4 / 3 * sx * sy * (self.far_m**3 - self.near_m**3)

    @property
    def planes(self) -> F64:
        """(6, 4): a homogeneous point p is inside if all distances planes @ p, m, are >= 0."""
        sx, sy = self.slopes
        sides = np.array([[-1, 0, sx, 0], [1, 0, sx, 0], [0, -1, sy, 0], [0, 1, sy, 0]])
        ends = np.array([[0, 0, 1, -self.near_m], [0, 0, -1, self.far_m]])
        return np.vstack([sides / np.linalg.norm(sides, axis=1, keepdims=True), ends])

    @property
    def bounding_sphere(self) -> tuple[float, float]:
        """z of the centre and radius of the smallest enclosing sphere, m."""
        sx, sy = self.slopes
        square = 1 + sx**2 + sy**2
        z = min(self.far_m, square * (self.far_m + self.near_m) / 2)
        return z, math.hypot(self.far_m * sx, self.far_m * sy, self.far_m - z)


class SampledFrustum:
    """The frustum of one camera with sample points about `interval_m` apart."""

    def __init__(self, frustum: Frustum, interval_m: float) -> None:
        self.frustum = frustum
        self.planes = frustum.planes
        self.points = _sample_points(frustum, interval_m)
        self.centre, self.radius = frustum.bounding_sphere

    def volume_inside(self, other: SampledFrustum, T_other_self: F64) -> F64:
        """Return its volume inside `other`, m^3 (N,), for poses T_other_self (N, 4, 4)."""
        planes = (other.planes @ T_other_self).transpose(
            1, 0, 2
        )  # (6, N, 4): planes first, so that min is fast
        distances = (planes.reshape(-1, 4) @ self.points).reshape(6, len(T_other_self), -1)
        count: I64 = np.count_nonzero(distances.min(axis=0) >= -_BORDER_TOLERANCE_M, axis=-1)
        volume: F64 = count * (self.frustum.volume / self.points.shape[1])
        return volume


def overlap_volumes(a: SampledFrustum, T_w_a: F64, b: SampledFrustum, T_w_b: F64) -> F64:
    """Return V_overlap, m^3 (N,), of one view T_w_a (4, 4) of camera a with views T_w_b (N, 4, 4) of b.

    Poses are of cameras, z forward, in one frame.
    """
    out = np.zeros(len(T_w_b))
    offset = T_w_b @ [0.0, 0.0, b.centre, 1.0] - T_w_a @ [0.0, 0.0, a.centre, 1.0]
    (close,) = np.nonzero((offset**2).sum(-1) < (a.radius + b.radius) ** 2)
    if len(close):
        T_b_a = inverse(T_w_b[close]) @ T_w_a
        out[close] = (a.volume_inside(b, T_b_a) + b.volume_inside(a, inverse(T_b_a))) / 2
    return out


def _sample_points(frustum: Frustum, interval_m: float) -> F64:
    """Return homogeneous points (4, M), M > 0. The interval is clipped, so that M is bounded whatever an
    agent's calibration is."""
    depth = frustum.far_m - frustum.near_m
    sizes = np.array([s * frustum.far_m for s in frustum.slopes] + [depth])
    steps = np.clip(interval_m, sizes / _MAX_SAMPLES, sizes / _MIN_SAMPLES)
    across_x, across_y, layers = np.ceil(sizes / steps).astype(int)
    x, y = ((np.arange(-n, n) + 0.5) * step for n, step in ((across_x, steps[0]), (across_y, steps[1])))
    z = frustum.near_m + (np.arange(layers) + 0.5) * depth / layers
    grid = np.stack(np.meshgrid(x, y, z), axis=-1).reshape(-1, 3)
    points: F64 = np.vstack([grid.T, np.ones(len(grid))])
    return points[:, (frustum.planes @ points >= -_BORDER_TOLERANCE_M).all(axis=0)]
