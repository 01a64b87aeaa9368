"""Which room serves whom, and the change of a run from one room to another, without sockets, threads or
clock."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from share.errors import WireError
from share.geometry import se3
from share.mapping.corrections import MapEvent, map_assignment
from share.mapping.places import FindKeyframe, FoundPlace, KeyframeSought
from share.protocol.edge_events import AddKeyframe
from share.protocol.peer import Peer
from share.site.building import BuildingGraph, RoomMap
from share.site.directory import RoomRanking
from share.site.room_finder import RoomFinder, RoomFound
from share.timing import seconds_to_ns
from share.types import Keyframe
from share.wire.codec import decode_only
from share.wire.layouts import Bytes
from share.wire.messages import Hello
from share.wire.room_messages import ClientHello

_KEPT_KEYFRAMES = 4  # of each run, the newest: one is searched in other rooms while the next ones come
_MAX_RUNS = 1024  # of which keyframes are kept
_KEPT_S = 60.0  # keyframes of a run that sends no more: longer than any search
_MAX_ROUTES = 65_536  # peers whose room is remembered
_MAX_WAIT_S = 1.0  # for the disk of the room that a run leaves; it may come back to the same place later


class RoomPort(Protocol):
    """What the switch needs of a room. Runs go by their keys."""

    def knows(self, peer_id: bytes) -> int | None:
        """Return the number of keyframes that a run of this peer has sent, also one that was forgotten, 0 for
        a client; None if the room knows neither."""

    def is_present(self, name: str) -> bool:
        """Return whether a run of this name takes part."""

    def run(self, key: str) -> Peer | None: ...

    def may_leave(self, key: str) -> bool:
        """Return whether a run takes part, and no keyframe of it waits for the disk."""

    def entry_objection(self, peer: Peer) -> str | None:
        """Return why a run may not come from another room; None if it may."""

    def hand_over(self, peer: Peer, room: str) -> None:
        """Let a run go on in another room."""

    def take_over(self, peer: Peer, room: str, place: MapEvent) -> None:
        """Take in a run of another room; place: where it is in a map of this one."""

    def find(self, request: FindKeyframe) -> None:
        """Search a keyframe in the map; the answer is a `KeyframeSought`."""

    def note_refused_entry(self, peer: Peer, room: str, reason: str) -> None:
        """Record that a run of this room may not go on in another."""


@dataclass
class _NewestKeyframes:
    """Of one run. last_ns: when the newest came, monotonic."""

    last_ns: int = 0
    by_id: OrderedDict[int, Keyframe] = field(default_factory=OrderedDict)


class RoomSwitch:
    """Routes peers to rooms. rooms: by name; the first is where those go of whom nothing is known.
    may_enter: whether the agent of a name may be in a room."""

    def __init__(self, rooms: Mapping[str, RoomPort], may_enter: Callable[[str, str], bool]) -> None:
        self._rooms, self._may_enter = rooms, may_enter
        self._finder = RoomFinder()
        self._routes: OrderedDict[bytes, str] = OrderedDict()  # by peer
        self._keyframes: OrderedDict[str, _NewestKeyframes] = OrderedDict()  # by run, the newest run last
        self._waiting: dict[str, tuple[RoomFound, int]] = {}  # by run: until when, for its room's disk
        self.building = BuildingGraph()
        self.changes = 0  # of rooms, since the start

    # ------------------------------------------------------------------ routes

    def room_of(self, peer_id: bytes, frames: Sequence[Bytes]) -> str | None:
        """Return the room for a message of this peer; None for the hello of a name that no room lets in."""
        room = self._routes.get(peer_id)
        if room is not None and self._rooms[room].knows(peer_id) is not None:
            return room
        known = {
            name: count for name, one in self._rooms.items() if (count := one.knows(peer_id)) is not None
        }
        if not known:  # and not remembered either: strangers may be many
            return self._room_for_new(frames)
        self._routes[peer_id] = room = max(known, key=lambda name: known[name])
        if len(self._routes) > _MAX_ROUTES:
            self._routes.popitem(last=False)
        return room

    def _room_for_new(self, frames: Sequence[Bytes]) -> str | None:
        """Return the room where the name of a hello is present, else the first that it may enter, if any; the
        first of all for other messages."""
        rooms = list(self._rooms)
        try:
            hello = decode_only(frames, Hello, ClientHello)
        except WireError:
            return rooms[0]
        if not isinstance(hello, Hello | ClientHello):
            return rooms[0]
        allowed = [room for room in rooms if self._may_enter(room, hello.name)]
        present = [room for room in allowed if self._rooms[room].is_present(hello.name)]
        return next(iter([*present, *allowed]), None)

    # ------------------------------------------------------------------ searches

    def add_keyframe(self, added: AddKeyframe, now_ns: int) -> None:
        """Keep a keyframe that a room's mapper gets, in case other rooms are to search it."""
        if added.keyframe.reference < 0:
            self._finder.begin_segment(added.key)
        kept = self._keyframes.setdefault(added.key, _NewestKeyframes())
        self._keyframes.move_to_end(added.key)
        kept.last_ns = now_ns
        kept.by_id[added.keyframe.id] = added.keyframe
        if len(kept.by_id) > _KEPT_KEYFRAMES:
            kept.by_id.popitem(last=False)
        if len(self._keyframes) > _MAX_RUNS:
            self._keyframes.popitem(last=False)

    def tick(self, now_ns: int) -> None:
        """Do what time makes due: changes of rooms that wait, runs that have fallen silent."""
        self._move_waiting(now_ns)
        while self._keyframes:
            run = next(iter(self._keyframes))
            if now_ns - self._keyframes[run].last_ns <= seconds_to_ns(_KEPT_S):
                break
            del self._keyframes[run]
            self._finder.forget(run)

    def add_ranking(self, ranking: RoomRanking, now_ns: int) -> None:
        """Have the rooms search a keyframe that look like it."""
        peer = self._rooms[ranking.room].run(ranking.key.agent)
        keyframe = self._keyframe(ranking.key.agent, ranking.key.id)
        if peer is None or peer.is_gone or keyframe is None:
            return
        allowed = tuple(one for one in ranking.scores if self._may_enter(one.room, peer.name))
        ranking = RoomRanking(ranking.room, ranking.key, allowed)
        for room in self._finder.choose_rooms(ranking, keyframe.T_odom_body, now_ns):
            self._rooms[room].find(FindKeyframe(ranking.key, keyframe, peer.hello.rig))

    def add_answer(self, room: str, sought: KeyframeSought, now_ns: int) -> None:
        """Take in a room's answer to a search; move the run if it is in another room."""
        found = self._finder.add_answer(room, sought.key, sought.place, now_ns)
        if found is not None:
            self._waiting[sought.key.agent] = found, now_ns + seconds_to_ns(_MAX_WAIT_S)
            self._move_waiting(now_ns)

    def _keyframe(self, run: str, id: int) -> Keyframe | None:
        kept = self._keyframes.get(run)
        return None if kept is None else kept.by_id.get(id)

    # ------------------------------------------------------------------ changes of rooms

    def _move_waiting(self, now_ns: int) -> None:
        """Move the runs that are in another room, once the keyframes that theirs has are stored."""
        for run, (found, until_ns) in list(self._waiting.items()):
            if self._move(run, found) or now_ns > until_ns:
                del self._waiting[run]

    def _move(self, run: str, found: RoomFound) -> bool:
        """Return whether there is nothing more to do for this run."""
        room = next((name for name, one in self._rooms.items() if self._is_in(one, run)), None)
        keyframe = self._keyframe(run, found.key.id)
        if room is None or room == found.room or keyframe is None:
            return True
        source, target = self._rooms[room], self._rooms[found.room]
        if not source.may_leave(run):
            return False
        peer = source.run(run)
        assert peer is not None
        if (reason := target.entry_objection(peer)) is not None:
            source.note_refused_entry(peer, found.room, reason)
            return True
        left, entered = peer.last_correction_event, _entry_event(run, keyframe, found.place)
        source.hand_over(peer, found.room)
        target.take_over(peer, room, entered)
        if left is not None and left.correction is not None and entered.correction is not None:
            maps = RoomMap(room, left.correction.map_id), RoomMap(found.room, found.place.map_id)
            self.building.add_crossing(maps[0], left.correction, maps[1], entered.correction)
        self._routes[peer.id] = found.room
        self._finder.forget(run)
        self.changes += 1
        return True

    @staticmethod
    def _is_in(room: RoomPort, run: str) -> bool:
        peer = room.run(run)
        return peer is not None and not peer.is_gone


def _entry_event(run: str, keyframe: Keyframe, place: FoundPlace) -> MapEvent:
    """Return the correction with which a run enters a map, by the place of one of its keyframes."""
    T_map_odom = se3.orthonormal(place.T_map_body @ se3.inverse(keyframe.T_odom_body))
    cov = se3.inverse_cov(keyframe.T_odom_body, place.cov)
    return map_assignment(run, place.map_id, T_map_odom, keyframe.id, cov)
