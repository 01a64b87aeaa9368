"""Which maps there are, and the transforms between the frames of joined maps, as agents see them.

Agents get `T_map_odom` by corrections. Where a correction takes an agent from one map into another within a
segment of its odometry, the two T_map_odom give the transform between the maps: what stays in place for this
agent stays where the room is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass

from share.geometry import se3
from share.mapping.corrections import MapsJoined
from share.types import F64, Correction

_MAX_JOINS = 256  # remembered; the oldest is forgotten


@dataclass(frozen=True, eq=False)
class MapMoved:
    """The contents of map `old` are in `new` now. T_new_old (4, 4). is_join: `old` is part of `new` for good;
    else one agent changed its map, as when a join is undone."""

    old: str
    new: str
    T_new_old: F64
    is_join: bool


class KnownMaps:
    """The maps of a room, from corrections, joins and stored solutions. Runs go by their keys."""

    def __init__(self) -> None:
        self._corrections: dict[str, Correction] = {}  # the newest of each run
        self._shown = Counter[str]()  # by map: runs whose newest correction it is
        self._segment_starts: dict[str, int] = {}  # by run: first keyframe of its present segment
        self._joins: dict[str, MapsJoined] = {}  # by absorbed map: not followed by an agent yet
        self._moves: dict[str, MapMoved] = {}  # by old map: joins that have been followed
        self._solved: frozenset[str] = frozenset()

    def __contains__(self, map_id: str) -> bool:
        return map_id in self._solved or map_id in self._shown

    def ids(self) -> frozenset[str]:
        """Return the maps of the runs' newest corrections, and those of the newest solution."""
        return self._solved | self._shown.keys()

    def add_solved(self, map_ids: Collection[str]) -> None:
        """Set the maps of the newest solution."""
        self._solved = frozenset(map_ids)

    def begin_segment(self, run: str, keyframe: int) -> None:
        """Record that a run's odometry began anew with this keyframe."""
        self._segment_starts[run] = keyframe

    def forget(self, run: str) -> None:
        self._set_correction(run, None)
        self._segment_starts.pop(run, None)

    def _set_correction(self, run: str, correction: Correction | None) -> None:
        """Set the newest correction of a run; None: the run is forgotten."""
        if (old := self._corrections.pop(run, None)) is not None:
            self._shown[old.map_id] -= 1
            if not self._shown[old.map_id]:
                del self._shown[old.map_id]
        if correction is not None:
            self._corrections[run] = correction
            self._shown[correction.map_id] += 1

    def record_join(self, joined: MapsJoined) -> None:
        """Record a join of the mapper; agents follow it with their next correction."""
        self._joins[joined.absorbed] = joined
        if len(self._joins) > _MAX_JOINS:
            del self._joins[next(iter(self._joins))]

    def add_correction(self, run: str, correction: Correction) -> MapMoved | None:
        """Add a correction sent to a run; return the move if it takes the run into another map."""
        start, old = self._segment_starts.get(run, 0), self._corrections.get(run)
        if correction.segment_keyframe < start:
            return None
        self._set_correction(run, correction)
        self._moves.pop(correction.map_id, None)  # it is there, perhaps again
        if old is None or old.map_id == correction.map_id or old.segment_keyframe < start:
            return None
        T = se3.orthonormal(correction.T_map_odom @ se3.inverse(old.T_map_odom))
        return self._moved(old.map_id, correction.map_id, T, self._leads_to(old.map_id, correction.map_id))

    def due_joins(self, present_runs: Collection[str]) -> list[MapMoved]:
        """Return joins of maps that no present run is shown: no correction will tell how they moved."""
        shown = {self._corrections[run].map_id for run in present_runs if run in self._corrections}
        due = [one for one in self._joins.values() if one.absorbed not in shown]
        return [self._moved(one.absorbed, one.survivor, one.T_survivor_absorbed, True) for one in due]

    def place(self, map_id: str, T: F64) -> tuple[str, F64] | None:
        """Return a pose (4, 4) in the map that stands in the place of `map_id`; None if none is known."""
        for _ in range(len(self._moves) + 1):
            if map_id in self:
                return map_id, T
            if (move := self._moves.get(map_id)) is None:
                return None
            map_id, T = move.new, se3.orthonormal(move.T_new_old @ T)
        return None

    def _leads_to(self, old: str, new: str) -> bool:
        """Return whether joins made the map `old` part of `new`."""
        for _ in range(len(self._joins) + 1):
            if old == new:
                return True
            if (joined := self._joins.get(old)) is None:
                return False
            old = joined.survivor
        return False

    def _moved(self, old: str, new: str, T: F64, is_join: bool) -> MapMoved:
        move = MapMoved(old, new, T, is_join)
        if is_join:
            self._joins.pop(old, None)
            self._moves.pop(new, None)
            self._moves[old] = move
            if len(self._moves) > _MAX_JOINS:
                del self._moves[next(iter(self._moves))]
        return move
