"""A client's replica of the room's objects, kept by the edge's changes and lists."""

from __future__ import annotations

from dataclasses import replace

from share.wire.room_messages import MAX_LISTED, ObjectList, ObjectsSeen, RoomObject


class ObjectReplica:
    """The objects of one session of the edge; those of the session before stay until the first list that is
    complete."""

    def __init__(self) -> None:
        self.is_complete = False
        self._session: int | None = None
        self._held: dict[int, RoomObject] = {}  # of this session, removed ones included
        self._earlier: dict[int, RoomObject] = {}
        self._list: ObjectList | None = None  # the newest

    @property
    def objects(self) -> dict[int, RoomObject]:
        """The present objects, by id."""
        return {n: one for n, one in (self._earlier | self._held).items() if not one.removed}

    def begin_session(self, session: int) -> None:
        earlier = list(self.objects.items())[: 2 * MAX_LISTED]  # an edge may begin ever new sessions
        self._session, self._earlier, self._held = session, dict(earlier), {}
        self._list, self.is_complete = None, False

    def add(self, change: RoomObject) -> RoomObject | None:
        """Take a change; return it if it is news."""
        held = self._held.get(change.object_id)
        if change.session != self._session or (held is not None and held.revision >= change.revision):
            return None
        is_known = held is not None or change.object_id in self._earlier
        if not is_known and len(self._held) >= 2 * MAX_LISTED:
            return None  # more than any edge has
        self._held[change.object_id] = change
        self._earlier.pop(change.object_id, None)
        return change if is_known or not change.removed else None

    def check(self, listed: ObjectList) -> list[RoomObject]:
        """Take a list; return the objects that it shows to be gone, with a reason."""
        if listed.session != self._session or (self._list and listed.revision < self._list.revision):
            return []
        self._list = listed
        revisions = dict(zip(listed.ids, listed.revisions, strict=True))
        lacking = [
            n for n, revision in revisions.items() if n not in self._held or self._held[n].revision < revision
        ]
        if lacking:
            return []
        self.is_complete = True
        unlisted = {n: one for n, one in self._held.items() if n not in revisions}
        old = {n: one for n, one in unlisted.items() if one.revision <= listed.revision} | self._earlier
        self._held = {n: one for n, one in self._held.items() if n not in old}
        self._earlier = {}
        return [replace(one, removed="it was removed meanwhile") for one in old.values() if not one.removed]

    def seen(self) -> ObjectsSeen | None:
        """Return what has been seen; None before all that the newest list names has come."""
        if self._list is None or not self.is_complete:
            return None
        revisions = dict(zip(self._list.ids, self._list.revisions, strict=True))
        if any(n not in self._held or self._held[n].revision < r for n, r in revisions.items()):
            return None
        return ObjectsSeen(self._list.session, self._list.revision)
