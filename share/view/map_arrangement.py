"""Where each map stands in the room: the first at the origin, the others beside it in a square, as long as
they hold a keyframe."""

from __future__ import annotations

import math

import numpy as np

from share.mapping.loops import KeyframeKey
from share.types import F64

_MAP_SPACING_M = 10.0  # between maps that are not joined


class MapArrangement:
    """Follows which map each keyframe is in. A change takes as long as what it moves is large."""

    def __init__(self) -> None:
        self._map_of: dict[KeyframeKey, str] = {}
        self._keyframes: dict[str, dict[KeyframeKey, None]] = {}  # by map; none is empty
        self._slots: dict[str, int] = {}
        self._has_gap = False

    def put(self, key: KeyframeKey, map_id: str | None) -> None:
        """Note that a keyframe is in this map now; None: it is gone."""
        old = self._map_of.get(key)
        if old == map_id:
            return
        if old is not None:
            del self._map_of[key], self._keyframes[old][key]
            if not self._keyframes[old]:
                del self._keyframes[old]
                self._has_gap = True
        if map_id is not None:
            self._map_of[key] = map_id
            self._keyframes.setdefault(map_id, {})[key] = None
            self._slots.setdefault(map_id, len(self._slots))

    def close_gaps(self) -> list[KeyframeKey]:
        """Move maps to where maps that are gone stood. Return the keyframes that move."""
        if not self._has_gap:
            return []
        self._has_gap = False
        before = self._slots
        self._slots = {one: k for k, one in enumerate(one for one in before if one in self._keyframes)}
        moved = [one for one, slot in self._slots.items() if before[one] != slot]
        return [key for map_id in moved for key in self._keyframes[map_id]]

    def offset(self, map_id: str) -> F64:
        """Return where the map's origin is (3,), m."""
        x, y = _square(self._slots.get(map_id, 0))
        return np.array([_MAP_SPACING_M * x, _MAP_SPACING_M * y, 0.0])


def _square(slot: int) -> tuple[int, int]:
    """Return column and row of a slot: slots fill squares of growing sides, so many maps fit one view."""
    side = math.isqrt(slot)
    beyond = slot - side * side
    return (beyond, side) if beyond <= side else (side, 2 * side - beyond)
