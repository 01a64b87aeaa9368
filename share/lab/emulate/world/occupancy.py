"""Distance of every place in a room from the nearest solid."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from share.lab.emulate.world.layout import Layout, winding_numbers
from share.types import F32, F64

STEP_M = 0.05
_COARSE_STEP_M = 0.1  # for rooms of more than _MAX_VOXELS
_MAX_VOXELS = 12_000_000
_POINT_CHUNK = 200_000  # sample points at a time
_SURFACE_OFFSET_M = 1e-4

BoolArray = NDArray[np.bool_]


class Occupancy:
    """Voxels of `step` m over a room. A voxel is solid where a triangle passes through it or a closed piece
    surrounds it, and everywhere outside. Distances are exact to about a voxel's diagonal."""

    def __init__(self, solid: BoolArray, step: float) -> None:
        """solid: (X, Y, Z), voxel (0, 0, 0) at the origin."""
        self.solid, self.step = solid, step

    @classmethod
    def from_layout(cls, layout: Layout, step: float | None = None) -> Occupancy:
        """Return the occupancy of a layout's solid pieces, shell and bounds; steps of 0.05 m, in large halls
        0.1 m."""
        step = step or (STEP_M if np.prod(layout.size) / STEP_M**3 < _MAX_VOXELS else _COARSE_STEP_M)
        shape = np.maximum(np.ceil(np.asarray(layout.size) / step - 1e-6).astype(int), 1)
        solid = np.zeros(shape, bool)
        for piece in layout.all_pieces:
            if piece.solid:
                fill_voxels(solid, piece.shape.mesh.triangles.astype(float), step)
        return cls(solid, step)

    @property
    def size(self) -> F64:
        """Return the extent (3,) m."""
        return np.array(self.solid.shape) * self.step

    @cached_property
    def distance(self) -> F32:
        """Return the distance (X, Y, Z) m of each voxel's centre from the nearest solid voxel's surface, 0
        inside."""
        from scipy.ndimage import distance_transform_edt

        free = np.pad(~self.solid, 1)
        cells = distance_transform_edt(free)[1:-1, 1:-1, 1:-1]
        return np.asarray(np.maximum(cells - 0.5, 0) * self.step, np.float32)

    def clearance(self, points: F64) -> F64:
        """Return the distance (N,) m of points (N, 3) from the nearest solid; 0 in it and outside the
        room."""
        from scipy.ndimage import map_coordinates

        voxels = (np.asarray(points, float) / self.step - 0.5).T
        inside = ((np.asarray(points) >= 0) & (np.asarray(points) <= self.size)).all(axis=1)
        distances = map_coordinates(self.distance, voxels, order=1, mode="nearest")
        return np.where(inside, distances, 0.0)

    def floor_clearance(self, low: float, high: float) -> tuple[F32, F64, float]:
        """Return, for a body between the heights `low` and `high` m: its distance (X, Y) m from the nearest
        solid at those heights; the place (2,) m of entry (0, 0); the step between entries, m. Choose `low` a
        little above the floor, which is solid."""
        import cv2

        a, b = int(np.floor(low / self.step)), max(int(np.ceil(high / self.step)), 1)
        free = ~self.solid[:, :, max(a, 0) : b].any(axis=2)
        padded = np.pad(free, 1).astype(np.uint8)
        cells = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
        grid = np.maximum(cells - 0.5, 0) * self.step
        return grid.astype(np.float32), np.full(2, self.step / 2), self.step


def fill_voxels(solid: BoolArray, triangles: F64, step: float) -> None:
    """Mark the voxels that triangles (F, 3, 3) m pass through or surround, in place."""
    low = np.floor(triangles.min((0, 1)) / step).astype(int) - 1
    high = np.ceil(triangles.max((0, 1)) / step).astype(int) + 1
    local = np.zeros(high - low, bool)
    _mark_surface(local, triangles - low * step, step)
    _mark_inside(local, triangles, low, step)
    a, b = np.clip(low, 0, solid.shape), np.clip(high, 0, solid.shape)
    target = tuple(slice(*ends) for ends in zip(a, b, strict=True))
    source = tuple(slice(*ends) for ends in zip(a - low, b - low, strict=True))
    solid[target] |= local[source]


def _mark_surface(local: BoolArray, triangles: F64, step: float) -> None:
    """Mark voxels on the triangles, by points on them at most half a step apart, a little behind their front:
    a face on the border of two voxels belongs to the one that the solid fills."""
    a, b, c = triangles.swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    longest = np.linalg.norm(np.stack([b - a, c - b, a - c]), axis=2).max(0)
    count = np.maximum(np.ceil(longest / (0.5 * step)).astype(int), 1)
    behind = triangles - _SURFACE_OFFSET_M * normal[:, None]
    for n in np.unique(count).tolist():
        i, j = np.nonzero(np.tri(n + 1, dtype=bool)[::-1])
        weights = np.stack([n - i - j, i, j], axis=1) / n
        weights = (1 - 1e-4) * weights + 1e-4 / 3
        same_count = behind[count == n]
        group = max(1, _POINT_CHUNK // len(weights))
        for k in range(0, len(same_count), group):
            points = (weights @ same_count[k : k + group]).reshape(-1, 3)
            local[tuple(np.floor(points / step).astype(int).T)] = True


def _mark_inside(local: BoolArray, triangles: F64, low: NDArray[np.int_], step: float) -> None:
    """Mark the empty regions that lie inside the mesh."""
    from scipy.ndimage import find_objects, label

    regions, _ = label(~local)
    outside = int(regions[0, 0, 0])
    for k, place in enumerate(find_objects(regions), start=1):
        if k == outside:
            continue
        region = regions[place] == k
        cells = np.argwhere(region) + [part.start for part in place]
        middle = (cells[len(cells) // 2] + low + 0.5) * step
        if winding_numbers(triangles, middle[None])[0] > 0.5:
            local[place] |= region
