"""The rooms of a site behind one front, each with its state machine, mapper and map file, and the directory
of places that finds an agent's room.

host (share.runtime.edge) -> RoomSwitch -> ServedRoom of each room -> host
    -> its mapper and map file, here or on another machine (share.runtime.remote_room)
    -> directory thread (share.site.directory) -> rankings -> RoomSwitch
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from share.config import Config
from share.errors import brief_reason
from share.event_kinds import EventKind
from share.mapping.corrections import MapEvent
from share.mapping.forgetting import DAY_S
from share.mapping.places import FindKeyframe, KeyframeSought, PlaceNews
from share.protocol.edge_events import AddKeyframe, PeerMessageReceived
from share.protocol.peer import Faults, Peer, fault_lines
from share.runtime.blinding import NoBlinding
from share.runtime.edge_observer import EdgeObserver
from share.runtime.fault_guard import FaultGuard
from share.runtime.mapper_process import start_mapper_process
from share.runtime.output_writer import JobThread
from share.runtime.remote_room import RemoteRooms
from share.runtime.room_host import RoomHost
from share.runtime.room_keeper import IDLE_S, RoomKeeper, RoomStart
from share.runtime.room_parts import StartMapping, open_here
from share.runtime.served_room import ServedRoom
from share.runtime.spare_mapper import SpareMapper
from share.runtime.worker_process import WorkerProcess
from share.site.directory import PlaceDirectory, RoomRanking
from share.site.report import site_report
from share.site.room_switch import RoomPort, RoomSwitch
from share.store.map_store import MapStore
from share.timing import Throttle
from share.wire.codec import encode
from share.wire.layouts import Bytes
from share.wire.messages import Refused

_NO_ROOM = "no room of this site lets this name in: add it to `agents` of one in the rooms file"
_STALE_REPORT = "no new report can be made: all values shown are old"
_MAPS_S = 5.0  # period in which the building's graph forgets maps that are gone
_MAX_VISITED = 2  # rooms at once, each a mapper that restores its map
_VISIT_S = 120.0  # after which a visit, such as of a room that is never idle, takes no place any more
_TIMEOUT_S = 5.0  # for the directory's thread at the end


@dataclass(frozen=True, eq=False)
class RoomSetup:
    """One room of a site. names: of the agents that may be in it; None: all."""

    name: str
    settings: Config
    store: MapStore | None
    observer: EdgeObserver
    names: frozenset[str] | None = None

    def allows(self, name: str) -> bool:
        return self.names is None or name in self.names


class SiteRooms:
    """The rooms of a site, until `close`; has the interface of one `ServedRoom`. Those of whom nothing is
    known begin in the first room. idle_s: see `RoomKeeper`. remote: where mappers run and map files are
    open; None: on this machine. Raises StoreError if the map of a room is unreadable."""

    def __init__(
        self,
        host: RoomHost,
        setups: Sequence[RoomSetup],
        start_ns: int,
        has_keys: bool,
        idle_s: float = IDLE_S,
        remote: RemoteRooms | None = None,
    ) -> None:
        self._remote = remote
        self._host, self._setups = host, {setup.name: setup for setup in setups}
        self._directory, self._thread = PlaceDirectory(), JobThread("directory")
        self._rankings: queue.SimpleQueue[RoomRanking] = queue.SimpleQueue()
        self._growing: set[str] = set()
        self._spare = SpareMapper()
        self._unvisited: deque[str] = deque()  # rooms whose places the directory does not have yet
        self._visits_s: dict[str, float] = {}  # when each room that is visited was woken up, monotonic
        self._maps_due_s = 0.0  # monotonic
        self._refusals, self._turned_away = Throttle(1.0, 5.0), Faults()  # of names that no room lets in
        self._guard = FaultGuard(lambda text: host.log_event("internal error", text))
        self._rooms: dict[str, RoomKeeper] = {}
        self._reports: dict[str, dict[str, Any]] = {}  # the last ones
        self._ports: dict[str, RoomPort] = {}
        self._switch = RoomSwitch(self._ports, lambda room, name: self._setups[room].allows(name))
        try:
            for name, setup in self._setups.items():
                room_host = _RoomHost(name, host, self)
                serve = partial(self._serve, setup, room_host, start_ns, has_keys)
                keep_days = setup.settings.edge.keep_days
                keep_s = None if keep_days is None else keep_days * DAY_S
                if setup.store is not None and setup.store.rows().tables["keyframe"]:
                    self._unvisited.append(name)
                open_room = open_here if remote is None else remote.open_room
                keeper = RoomKeeper(setup.store, serve, room_host, idle_s, keep_s, True, open_room)
                self._rooms[name], self._ports[name] = keeper, _Port(keeper)
        except BaseException:
            self.close()
            raise
        if remote is None and any(setup.store is not None for setup in setups):
            self._spare.prepare()

    def _serve(
        self,
        setup: RoomSetup,
        host: RoomHost,
        start_ns: int,
        has_keys: bool,
        start: RoomStart,
    ) -> ServedRoom:
        """Start a room. Where its map file is unchanged the directory knows what it holds."""
        return ServedRoom(
            setup.settings,
            host,
            start_ns,
            start.store,
            setup.observer,
            NoBlinding(),
            has_keys,
            _Neighbour(setup.name, self, keeps_places=start.is_unchanged),
            start.totals,
            self._mapper_starter(start),
        )

    def _mapper_starter(self, start: RoomStart) -> StartMapping:
        if start.is_unused:
            return _never_started
        if self._remote is not None:
            return start.start_mapper or self._remote.start_mapper
        return self._spare.take

    def handle(self, event: PeerMessageReceived) -> None:
        room = self._switch.room_of(event.peer_id, event.frames)
        if room is None:
            self._host.send(event.peer_id, encode(Refused(_NO_ROOM)))
            self._turned_away.add(_NO_ROOM, time.monotonic_ns())
            if (more := self._refusals.admit("", time.monotonic_ns())) is not None:
                self._host.log_event("refused", f"{_NO_ROOM} (and {more} more)" if more else _NO_ROOM)
        else:
            self._rooms[room].handle(self._limited(event, self._setups[room]))

    def _limited(self, event: PeerMessageReceived, setup: RoomSetup) -> PeerMessageReceived:
        """Return the event with the names that may be in the room, of those that its sender may act for."""
        if setup.names is None:
            return event
        names = setup.names if event.allowed_names is None else setup.names & event.allowed_names
        return replace(event, allowed_names=names)

    def step(self) -> None:
        """Handle the answers of all rooms and of the directory, and the time that has passed."""
        for name, room in self._rooms.items():
            with self._guard.step(f"room '{name}'"):  # the others go on
                room.step()
        self._visit_rooms()
        with self._guard.step("a change of rooms"):
            self._continue_searches()

    def _visit_rooms(self) -> None:
        """Wake up the rooms one after the other once, so that the directory gets to know their places."""
        now_s = time.monotonic()
        visited = [name for name, room in self._rooms.items() if room.is_visited]
        self._visits_s = {name: self._visits_s.get(name, now_s) for name in visited}
        busy = sum(now_s - since_s < _VISIT_S for since_s in self._visits_s.values())
        while self._unvisited and busy < _MAX_VISITED:
            self._rooms[self._unvisited.popleft()].visit()
            busy += 1

    def _continue_searches(self) -> None:
        while not self._rankings.empty():
            self._switch.add_ranking(self._rankings.get(), time.monotonic_ns())
        self._switch.tick(time.monotonic_ns())
        if time.monotonic() >= self._maps_due_s:
            self._maps_due_s = time.monotonic() + _MAPS_S
            self._switch.building.keep(lambda one: self._rooms[one.room].may_have_map(one.map_id))

    def stop(self) -> None:
        """From now on the death of a process is expected. Safe from any thread and from a signal handler."""
        for room in list(self._rooms.values()):
            room.stop()

    def close(self) -> str | None:
        """End all processes and threads. Return which map files are incomplete and why, None if none is."""
        if self._remote is not None:
            self._end_processes()
        reasons = []
        for name, room in self._rooms.items():
            try:
                reason = room.close()
            except Exception as error:  # the others still write their files
                reason = brief_reason(error)
            if reason is not None:
                reasons.append(f"room '{name}': {reason}")
        self._thread.stop(_TIMEOUT_S)
        self._spare.close()
        return "; ".join(reasons) or None

    def _end_processes(self) -> None:
        """End the mappers on all machines at once: one after the other takes long."""
        rooms = [keeper.room for keeper in self._rooms.values() if keeper.room is not None]
        threads = [threading.Thread(target=room.end_processes, daemon=True) for room in rooms]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    # ------------------------------------------------------------------ what is shown

    def show_poses(self) -> None:
        """Show the observer of each room the newest poses of its runs."""
        for room in self._rooms.values():
            room.show_poses()

    def show_report(self, report: Mapping[str, Any]) -> None:
        """Show the observer of each room what the last `report` says of it."""
        for name, room_report in self._reports.items():
            self._setups[name].observer.add_report(room_report)

    def series(self) -> Mapping[str, Mapping[str, Any]]:
        """Return `series` of each room."""
        return {name: room.series() for name, room in self._rooms.items()}

    def report(self) -> dict[str, Any]:
        """Return edge.json of the whole site."""
        for name, room in self._rooms.items():
            self._update_report(name, room)
        reports = self._reports
        directory = {"keyframes": len(self._directory), "waiting": self._thread.pending_jobs}
        report = site_report(reports, self._switch.building.poses)
        trouble = [*report["trouble"], *filter(None, [self._guard.trouble])]
        turned_away = "agents that no room lets in", "hellos refused", self._turned_away
        refused = [*report["refused"], *fault_lines([turned_away], time.monotonic_ns())]
        lines = {"trouble": trouble, "refused": refused}
        return report | lines | {"room_changes": self._switch.changes, "directory": directory}

    def _update_report(self, name: str, room: RoomKeeper) -> None:
        """Make a room's report. A failure costs this one: the last one is shown, and says so."""
        report = {**self._reports.get(name, {}), "trouble": [_STALE_REPORT]}
        with self._guard.step(f"a report of room '{name}'"):  # the others are shown as they are
            report = room.report()
        if name in self._reports or "session" in report:  # else there never was one
            self._reports[name] = report

    # ------------------------------------------------------------------ what rooms tell

    def begin_session(self, room: str) -> None:
        self._thread.submit(partial(self._directory.remove_room, room))

    def add_keyframe(self, added: AddKeyframe) -> None:
        self._switch.add_keyframe(added, time.monotonic_ns())

    def add_places(self, room: str, news: Sequence[PlaceNews]) -> None:
        self._thread.submit(partial(self._update_directory, room, news))

    def add_sought(self, room: str, sought: KeyframeSought) -> None:
        with self._guard.step("a change of rooms"):
            self._switch.add_answer(room, sought, time.monotonic_ns())

    def expect_growth(self, room: str, is_expected: bool) -> None:
        """Tell the host as long as the map of one room is restored."""
        (self._growing.add if is_expected else self._growing.discard)(room)
        self._host.expect_growth(bool(self._growing))

    def _update_directory(self, room: str, news: Sequence[PlaceNews]) -> None:
        """Job of the directory's thread."""
        for one in news:
            if (ranking := self._directory.update(room, one)) is not None:
                self._rankings.put(ranking)
        if not self._rankings.empty():
            self._host.wake()


def _never_started(
    on_answer: Callable[[Any], None], on_death: Callable[[str], None], start_delay_s: float
) -> WorkerProcess:
    """Return the mapper's process of a room that falls asleep at once."""
    return start_mapper_process(on_answer, on_death, None)


class _RoomHost:
    """The host of one room: it names the room in what is logged."""

    def __init__(self, room: str, host: RoomHost, site: SiteRooms) -> None:
        self._room, self._host, self._site = room, host, site

    def wake(self) -> None:
        self._host.wake()

    def send(self, peer_id: bytes, frames: Sequence[Bytes]) -> None:
        self._host.send(peer_id, frames)

    def expect_growth(self, is_expected: bool) -> None:
        self._site.expect_growth(self._room, is_expected)

    def record(self, fields: dict[str, Any]) -> None:
        self._host.record({**fields, "room": self._room})

    def log_event(self, event: EventKind, reason: str) -> None:
        self._host.log_event(event, f"room '{self._room}': {reason}")


class _Port(RoomPort):
    """What the switch asks of one room."""

    def __init__(self, keeper: RoomKeeper) -> None:
        self._keeper = keeper

    def knows(self, peer_id: bytes) -> int | None:
        return self._keeper.knows(peer_id)

    def is_present(self, name: str) -> bool:
        return (protocol := self._keeper.protocol) is not None and protocol.is_present(name)

    def run(self, key: str) -> Peer | None:
        return None if (protocol := self._keeper.protocol) is None else protocol.run(key)

    def may_leave(self, key: str) -> bool:
        return (protocol := self._keeper.protocol) is not None and protocol.may_leave(key)

    def entry_objection(self, peer: Peer) -> str | None:
        room = self._keeper.room
        if room is None or room.is_waiting:
            return "its map cannot be read now"
        return room.protocol.entry_objection(peer, time.monotonic_ns())

    def hand_over(self, peer: Peer, room: str) -> None:
        served = self._awake()
        served.execute(served.protocol.hand_over(peer, room, time.monotonic_ns()))

    def take_over(self, peer: Peer, room: str, place: MapEvent) -> None:
        served = self._awake()
        served.execute(served.protocol.take_over(peer, room, place, time.monotonic_ns()))

    def find(self, request: FindKeyframe) -> None:
        self._keeper.find(request)

    def note_refused_entry(self, peer: Peer, room: str, reason: str) -> None:
        served = self._awake()
        served.execute(served.protocol.note_refused_entry(peer, room, reason, time.monotonic_ns()))

    def _awake(self) -> ServedRoom:
        assert self._keeper.room is not None  # a run takes part in it, or may enter
        return self._keeper.room


class _Neighbour:
    """What one room tells of itself, with its name. keeps_places: the directory knows its first session."""

    def __init__(self, room: str, site: SiteRooms, keeps_places: bool) -> None:
        self._room, self._site, self._keeps_places = room, site, keeps_places

    def note_session(self) -> None:
        if not self._keeps_places:
            self._site.begin_session(self._room)
        self._keeps_places = False

    def note_keyframe(self, added: AddKeyframe) -> None:
        self._site.add_keyframe(added)

    def note_places(self, news: Sequence[PlaceNews]) -> None:
        self._site.add_places(self._room, news)

    def note_sought(self, sought: KeyframeSought) -> None:
        self._site.add_sought(self._room, sought)
