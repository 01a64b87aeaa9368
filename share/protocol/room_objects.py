"""The objects of a room: what is where, in which map, since which revision.

Every change has the room's next revision, so a client lacks what is newer than what it has seen.
Removed objects stay in the list for a while, with the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from share.geometry import se3
from share.mapping.map_changes import SaveObject
from share.protocol.known_maps import MapMoved
from share.timing import seconds_to_ns
from share.types import F64
from share.wire.room_messages import MAX_LISTED, ObjectKind, ObjectList, RoomObject, no_object_text

MAX_OBJECTS = 64
MAX_OWNED = 16
_REMOVED_S = 60.0  # a removed object is listed for so long
_MAX_REMOVED = MAX_LISTED - MAX_OBJECTS


class RoomObjects:
    """The objects of one room. session: of the edge. Methods raise ValueError, its text for a person, for
    what is refused."""

    def __init__(self, session: int, stored: Iterable[SaveObject] = ()) -> None:
        self.revision = 0
        self._session = session
        self._kept: dict[int, SaveObject] = {}
        self._removed: dict[int, tuple[RoomObject, int]] = {}  # by id: with the time, the oldest first
        self._missing: set[int] = set()  # objects without their map at the last check
        for one in stored:
            if len(self._kept) < MAX_OBJECTS:
                self._keep(one.object, one.home_map)

    def __len__(self) -> int:
        return len(self._kept)

    def kept(self) -> list[SaveObject]:
        """Return all objects, as they are stored."""
        return list(self._kept.values())

    def put(self, owner: str, object_id: int, kind: ObjectKind, map_id: str, T: F64) -> SaveObject:
        """Place an object, or move it; T (4, 4) in the map. owner: of a new one."""
        old = self._kept.get(object_id)
        if old is not None:
            if old.object.kind is not kind:
                raise ValueError(f"object {object_id} is a {old.object.kind}; give another id")
            return self._keep(replace(old.object, map_id=map_id, T_map_object=T), map_id)
        if len(self._kept) >= MAX_OBJECTS:
            raise ValueError(f"the room has {MAX_OBJECTS} objects already; remove one first")
        if sum(one.object.owner == owner for one in self._kept.values()) >= MAX_OWNED:
            raise ValueError(f"'{owner}' has placed {MAX_OWNED} objects already; remove one first")
        return self._keep(RoomObject(self._session, 0, object_id, kind, owner, map_id, T), map_id)

    def remove(self, object_id: int, reason: str, now_ns: int) -> RoomObject:
        """Remove an object; return it as its removal is sent."""
        if (kept := self._kept.pop(object_id, None)) is None:
            raise ValueError(no_object_text(object_id))
        self.revision += 1
        gone = replace(kept.object, revision=self.revision, removed=reason)
        self._missing.discard(object_id)
        self._removed[object_id] = gone, now_ns
        if len(self._removed) > _MAX_REMOVED:
            del self._removed[next(iter(self._removed))]
        return gone

    def follow(self, move: MapMoved, now_ns: int) -> list[SaveObject | RoomObject]:
        """Move objects with their map; return those that changed, removed ones as they are sent."""
        out: list[SaveObject | RoomObject] = []
        for kept in self.kept():
            if kept.object.map_id != move.old or not (move.is_join or kept.home_map == move.new):
                continue
            T = se3.orthonormal(move.T_new_old @ kept.object.T_map_object)
            try:
                moved = replace(kept.object, map_id=move.new, T_map_object=T)
                out.append(self._keep(moved, kept.home_map))
            except ValueError:  # maps that corrections have thrown apart
                reason = f"in the map {move.new} it would be too far away"
                out.append(self.remove(kept.object.object_id, reason[:200], now_ns))
        return out

    def remove_missing(self, has_map: Callable[[str], bool], now_ns: int) -> list[RoomObject]:
        """Remove the objects that had no map at the last check either."""
        missing = {one.object.object_id for one in self._kept.values() if not has_map(one.object.map_id)}
        gone, self._missing = missing & self._missing, missing
        maps = {object_id: self._kept[object_id].object.map_id for object_id in gone}
        return [
            self.remove(object_id, f"its map {maps[object_id]} is gone", now_ns) for object_id in sorted(gone)
        ]

    def expire(self, now_ns: int) -> None:
        """Forget objects that were removed long ago."""
        limit_ns = now_ns - seconds_to_ns(_REMOVED_S)
        self._removed = {n: row for n, row in self._removed.items() if row[1] >= limit_ns}

    def newer_than(self, revision: int) -> list[RoomObject]:
        """Return what has changed since a revision, oldest change first."""
        return sorted((x for x in self._all() if x.revision > revision), key=lambda x: x.revision)

    def listed(self) -> ObjectList:
        """Return the list of all that there is."""
        ids = {one.object_id: one.revision for one in self._all()}
        return ObjectList(self._session, self.revision, tuple(ids), tuple(ids.values()))

    def _all(self) -> list[RoomObject]:
        return [*(row[0] for row in self._removed.values()), *(one.object for one in self._kept.values())]

    def _keep(self, changed: RoomObject, home_map: str) -> SaveObject:
        stored = replace(changed, session=self._session, revision=self.revision + 1)
        self.revision += 1
        self._removed.pop(stored.object_id, None)
        self._kept[stored.object_id] = SaveObject(stored, home_map)
        return self._kept[stored.object_id]
