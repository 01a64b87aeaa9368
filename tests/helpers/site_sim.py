"""Several real rooms behind one switch in virtual time, on `edge_sim`: agents walk from room to room."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from helpers.edge_sim import MS, ModelRun, Person, Town, Walls, look

from share.config import Config
from share.geometry import se3
from share.mapping.corrections import MapEvent
from share.mapping.map_changes import StoredMap
from share.mapping.mapper import Mapper
from share.mapping.places import FindKeyframe, PlaceNewsLog
from share.mapping.steps import SolveStep, Step
from share.protocol import agent_events as ev
from share.protocol import edge_events as ed
from share.protocol.common_events import EdgeMessageReceived, Tick
from share.protocol.edge import EdgeProtocol
from share.protocol.peer import Peer, restored_runs
from share.site.directory import PlaceDirectory
from share.site.room_switch import RoomSwitch
from share.store.map_store import MapStore
from share.types import F64, View


class SimRoom(ModelRun):
    """A room: state machine, mapper and solver, and what the switch asks of it."""

    def __init__(
        self,
        name: str,
        site: Site,
        config: Config,
        session: int,
        has_store: bool,
        store: MapStore | None = None,
    ) -> None:
        """store: its map file, of which it continues the map."""
        super().__init__(config, session)
        self.name, self.store, self._site = name, store, site
        kept = StoredMap() if store is None else store.load()
        restored = restored_runs(kept, config.merge.enter_m)
        self.machine = EdgeProtocol(config, session, has_store, restored, forgotten=kept.forgotten)
        self.mapper = Mapper(config, news=PlaceNewsLog())
        if kept.runs:
            self.mapper.restore(kept)

    def knows(self, peer_id: bytes) -> int | None:
        return self.machine.knows(peer_id)

    def is_present(self, name: str) -> bool:
        return self.machine.is_present(name)

    def run(self, key: str) -> Peer | None:
        return self.machine.run(key)

    def may_leave(self, key: str) -> bool:
        return self.machine.may_leave(key)

    def entry_objection(self, peer: Peer) -> str | None:
        return self.machine.entry_objection(peer, self._site.now_ns)

    def hand_over(self, peer: Peer, room: str) -> None:
        self._site.execute(self, self.machine.hand_over(peer, room, self._site.now_ns))

    def take_over(self, peer: Peer, room: str, place: MapEvent) -> None:
        self._site.execute(self, self.machine.take_over(peer, room, place, self._site.now_ns))

    def find(self, request: FindKeyframe) -> None:
        self.mapper.search.add(request)
        self._site.continue_mapping(self)

    def note_refused_entry(self, peer: Peer, room: str, reason: str) -> None:
        self._site.execute(self, self.machine.note_refused_entry(peer, room, reason, self._site.now_ns))


class Site(Town):
    """Rooms by name, their directory, and everybody. The disk of a room answers after `disk_ms`; `folder`: of
    the rooms' map files."""

    def __init__(
        self,
        people: list[Person],
        rooms: tuple[str, ...],
        refused: frozenset[tuple[str, str]] = frozenset(),
        disk_ms: float | None = None,
        folder: Path | None = None,
        **changes: Any,
    ) -> None:
        super().__init__(people, **changes)
        self._disk_ms = 0.0 if disk_ms is None and folder is not None else disk_ms
        self._names, self._refused, self._folder = rooms, refused, folder
        self.start(100)

    def start(self, session: int) -> None:
        """Start all rooms, also again; session: of the first."""
        self.rooms = {
            name: SimRoom(
                name, self, self.config, session + i, self._disk_ms is not None, self._open_store(name)
            )
            for i, name in enumerate(self._names)
        }
        self.directory = PlaceDirectory()
        self.switch = RoomSwitch(self.rooms, lambda room, name: (room, name) not in self._refused)

    def stop(self) -> None:
        """End all rooms, as by a crash: what has not reached the disk is lost."""
        self._later.clear()
        for room in self.rooms.values():
            if room.store is not None:
                room.store.close()

    def map_file(self, room: str) -> Path:
        assert self._folder is not None
        return self._folder / f"{room}.sqlite"

    def _open_store(self, room: str) -> MapStore | None:
        return None if self._folder is None else MapStore.open(self.map_file(room))

    def to_edge(self, event: ed.EdgeEvent) -> None:
        if isinstance(event, ed.PeerMessageReceived):
            if (name := self.switch.room_of(event.peer_id, event.frames)) is not None:
                self.execute(self.rooms[name], self.rooms[name].machine.handle(event, self.now_ns))
        elif isinstance(event, Tick):
            for room in self.rooms.values():
                self.execute(room, room.machine.handle(event, self.now_ns))
            self.switch.tick(self.now_ns)

    def execute(self, room: SimRoom, effects: list[ed.EdgeEffect]) -> None:
        for effect in effects:
            match effect:
                case ed.SendToPeer(peer, frames):
                    copy = [bytes(f) for f in frames]
                    for late in self.weather.delays_ns():
                        self._in(
                            late,
                            lambda peer=peer, copy=copy: self.to_agent(peer, EdgeMessageReceived(copy)),
                        )
                case ed.AddRun(key, hello):
                    room.mapper.add_run(key, hello)
                case ed.SetPresence(key, here):
                    room.mapper.set_present(key, here)
                    self.continue_mapping(room)
                case ed.AddKeyframe(key, keyframe, is_extra):
                    self.switch.add_keyframe(effect, self.now_ns)
                    self.continue_mapping(room, room.mapper.add_keyframe(key, keyframe, is_extra))
                case ed.DropRun(key):
                    room.mapper.remove_run(key)
                case ed.SaveChanges(ticket, changes):
                    if room.store is not None:
                        room.store.write(changes)
                    if self._disk_ms is not None:
                        saved = ed.ChangesSaved(ticket)
                        self._in(round(self._disk_ms * MS), lambda saved=saved: self._tell(room, saved))
                case ed.WriteEvent(fields):
                    self.records.append({**fields, "room": room.name})

    def _tell(self, room: SimRoom, event: ed.EdgeEvent) -> None:
        self.execute(room, room.machine.handle(event, self.now_ns))

    def continue_mapping(self, room: SimRoom, map_events: list[MapEvent] | None = None) -> None:
        """The room's mapper has decided something, and goes on to its next steps."""
        result = ed.MapperResult(
            tuple(map_events or ()), room.mapper.take_changes(), room.mapper.take_empty_runs()
        )
        self._in(0, lambda: self._tell(room, result))
        for step in (room.mapper.next_lookup(), room.mapper.next_solve()):
            if step is not None:
                outcome = step.run(room.solver) if isinstance(step, SolveStep) else step.run()
                self._in(
                    self._job_ns,
                    lambda step=step, outcome=outcome: self._finish(room, step, outcome),
                )
        for news in room.mapper.take_place_news():
            if (ranking := self.directory.update(room.name, news)) is not None:
                self.switch.add_ranking(ranking, self.now_ns)
        for sought in room.mapper.search.take_answers():
            self.switch.add_answer(room.name, sought, self.now_ns)

    def _finish(self, room: SimRoom, step: Step, outcome: object) -> None:
        self.continue_mapping(room, room.mapper.finish_step(step, outcome, self._job_ns / MS))

    def room_of(self, name: str) -> str:
        """The room in which the agent of this name takes part."""
        return next(room for room, one in self.rooms.items() if one.is_present(name))

    def events(self, kind: str) -> list[dict[str, Any]]:
        return [record for record in self.records if record["event"] == kind]

    def poses(self, name: str) -> list[ev.LocalisedPose]:
        return self.event(ev.LocalisedPose, name)


class Walker(Person):
    """Walks once around a room, then around the next, with odometry that goes on. Places: one room each, in
    frames of their own."""

    def __init__(self, name: str, places: list[Walls], start: float, run_id: int, per_room: int) -> None:
        super().__init__(name, places[0], start, run_id)
        self._places, self._per_room = places, per_room

    def step(self) -> tuple[F64, View]:
        n = len(self.T_world_body)
        self.place = self._places[min(n // self._per_room, len(self._places) - 1)]
        return super().step()


def still(person: Person, T_world_cam: F64, seed: int) -> View:
    """What a person sees from one place."""
    return look(person.place, T_world_cam, np.random.default_rng(seed))


def T_map_world(person: Person, pose: ev.LocalisedPose, frame: int) -> F64:
    """Where the room is in the map by what one agent is shown at a frame."""
    assert pose.T_map_odom is not None
    T_map_body = pose.T_map_odom @ pose.T_odom_body
    return T_map_body @ se3.inverse(person.T_world_body[frame])
