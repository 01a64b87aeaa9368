"""Free floor as a grid: the distance of each place from the nearest obstacle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from share.lab.emulate.world.occupancy import Occupancy
from share.types import F64

_MIN_OBSTACLE_M = 0.10  # lower steps are walked over
_MAX_OBSTACLE_M = 1.95  # higher beams are walked under
_VOXELS_PER_CELL = 2  # voxels of the occupancy per grid cell


@dataclass(frozen=True, eq=False)
class Floor:
    """clearance (X, Y) m at the places origin + (i, j) * step m: distance to the nearest obstacle between
    floor and head, 0 inside one."""

    clearance: F64
    step: float
    origin: float = 0.0

    def clearance_at(self, xy: F64) -> F64:
        """Return the clearance (N,) m at places (N, 2) m, bilinear; outside the grid that of its edge."""
        i, f = self._cells(xy)
        c = self.clearance
        low = c[i[:, 0], i[:, 1]] * (1 - f[:, 1]) + c[i[:, 0], i[:, 1] + 1] * f[:, 1]
        high = c[i[:, 0] + 1, i[:, 1]] * (1 - f[:, 1]) + c[i[:, 0] + 1, i[:, 1] + 1] * f[:, 1]
        out: F64 = low * (1 - f[:, 0]) + high * f[:, 0]
        return out

    def clearance_gradient(self, xy: F64) -> F64:
        """Return the gradient (N, 2) of the clearance."""
        h = self.step * np.eye(2)
        return np.stack([self.clearance_at(xy + d) - self.clearance_at(xy - d) for d in h], axis=1) / (
            2 * self.step
        )

    def _cells(self, xy: F64) -> tuple[np.ndarray, F64]:
        last_cell = np.array(self.clearance.shape) - 1
        place = ((np.asarray(xy) - self.origin) / self.step).clip(0, last_cell - 1e-9)
        cell = place.astype(int)
        return cell, place - cell


def floor_from_occupancy(occupancy: Occupancy) -> Floor:
    """Return the floor for people and robots alike: the space under a table is not free."""
    clearance, origin, step = occupancy.floor_clearance(_MIN_OBSTACLE_M, _MAX_OBSTACLE_M)
    grid = clearance[::_VOXELS_PER_CELL, ::_VOXELS_PER_CELL].astype(np.float64)
    return Floor(grid, step * _VOXELS_PER_CELL, float(origin[0]))
