"""The floor that furniture leaves to walk on."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from share.lab.emulate.world.scenes.plan import Plan

_STEP = 0.1  # m
_BODY = 0.45  # m; how far from all things the middle of a walker stays
_LOW, _HIGH = 0.1, 1.9  # m; what stands between these heights is in the way


def clear(plan: Plan, least: float, names: Collection[str]) -> None:
    """Take things of these `names` away again, the last first, until `least` of the floor can be walked
    on in one piece, or there are none left."""
    while walkable(plan) < least:
        gone = next((p for p in reversed(plan.pieces) if p.name.rpartition(" ")[0] in names), None)
        if gone is None:
            return
        plan.pieces.remove(gone)


def walkable(plan: Plan) -> float:
    """The largest connected place for a walker's middle, as a share of the floor; things count as the
    boxes round them, so it is a little less than `Occupancy` finds."""
    import cv2

    free = np.ones(np.ceil(np.array(plan.size[:2]) / _STEP - 1e-6).astype(int), np.uint8)
    for piece in plan.pieces:
        low, high = piece.bounds
        if piece.solid and low[2] < _HIGH and high[2] > _LOW:
            (a, b), (c, d) = np.floor(low[:2] / _STEP + 1e-6), np.ceil(high[:2] / _STEP - 1e-6)
            free[max(int(a), 0) : int(c), max(int(b), 0) : int(d)] = 0
    cells = cv2.distanceTransform(np.pad(free, 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    middle = ((cells - 0.5) * _STEP >= _BODY).astype(np.uint8)
    _, _, places, _ = cv2.connectedComponentsWithStats(middle, connectivity=4)
    return float(places[1:, cv2.CC_STAT_AREA].max(initial=0)) / free.size
