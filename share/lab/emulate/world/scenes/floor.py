"""Free floor between the furniture."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from share.lab.emulate.world.scenes.layout_builder import LayoutBuilder

_STEP = 0.1
_WALKER_CLEARANCE_M = 0.45  # least distance of a walker's middle from objects
_MIN_OBSTACLE_M, _MAX_OBSTACLE_M = 0.1, 1.9  # obstacles are objects between these heights


def clear_floor(plan: LayoutBuilder, min_share: float, names: Collection[str]) -> None:
    """Remove pieces of these `names`, the last first, until a connected share `min_share` of the floor is
    walkable, or none are left."""
    while walkable_share(plan) < min_share:
        removed = next((p for p in reversed(plan.pieces) if p.name.rpartition(" ")[0] in names), None)
        if removed is None:
            return
        plan.pieces.remove(removed)


def walkable_share(plan: LayoutBuilder) -> float:
    """Return the largest connected area for a walker's middle, as a share of the floor; objects count as
    their boxes, so it is a little less than by `Occupancy`."""
    import cv2

    free = np.ones(np.ceil(np.array(plan.size[:2]) / _STEP - 1e-6).astype(int), np.uint8)
    for piece in plan.pieces:
        low, high = piece.bounding_box
        if piece.solid and low[2] < _MAX_OBSTACLE_M and high[2] > _MIN_OBSTACLE_M:
            (a, b), (c, d) = np.floor(low[:2] / _STEP + 1e-6), np.ceil(high[:2] / _STEP - 1e-6)
            free[max(int(a), 0) : int(c), max(int(b), 0) : int(d)] = 0
    cells = cv2.distanceTransform(np.pad(free, 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    middle = ((cells - 0.5) * _STEP >= _WALKER_CLEARANCE_M).astype(np.uint8)
    _, _, places, _ = cv2.connectedComponentsWithStats(middle, connectivity=4)
    return float(places[1:, cv2.CC_STAT_AREA].max(initial=0)) / free.size
