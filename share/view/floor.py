"""The floor of the drawn room, a grid below the points of its maps."""

from __future__ import annotations

import numpy as np

from share.types import F64
from share.view.drawing import FloorGrid

_STEP_M = 0.3  # a lower floor is not drawn again for less
_MARGIN_M, _MOST_SPARE_M = 1.0, 6.0


class DrawnFloor:
    """About as wide as the points; drawn again only where they have left it, or it is far too large."""

    def __init__(self) -> None:
        self.grid: FloorGrid | None = None
        self._bounds: dict[str, F64] = {}  # of points, by name: low x, y, z, high x, y

    def set_points(self, name: str, points: F64) -> None:
        """Set the points (N, 3) of this name, m in the room; N may be 0."""
        self._bounds.pop(name, None)
        if len(points):
            low, high = np.percentile(points, [2, 98], axis=0)
            self._bounds[name] = np.concatenate([low, high[:2]])

    def take_change(self) -> FloorGrid | None:
        """Return the floor if it has to be drawn again."""
        if not self._bounds:
            return None
        bounds = np.array(list(self._bounds.values()))
        z = float(np.percentile(bounds[:, 2], 10))
        low, high = bounds[:, :2].min(axis=0) - _MARGIN_M, bounds[:, 3:].max(axis=0) + _MARGIN_M
        old = self.grid
        if old is not None and abs(z - old.z) < _STEP_M:
            spare = np.concatenate([low - old.low, old.high - high])  # on each side
            if (spare >= 0).all() and (spare < _MOST_SPARE_M).all():
                return None
        margin = 0.0 if old is None else 1.5  # it grows by steps
        low, high = np.floor(low - margin), np.ceil(high + margin)
        self.grid = FloorGrid(z, (float(low[0]), float(low[1])), (float(high[0]), float(high[1])))
        return self.grid
