"""One session of a room: the state machine of its agents, and the processes and threads that work for it.

Agents see its number. After the mapper has died a new session begins, and agents resend what the map lacks.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from share.config import Config
from share.mapping.places import FindKeyframe
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import (
    AddKeyframe,
    AddRun,
    DropRun,
    EdgeEffect,
    SaveChanges,
    SetCredential,
    SetPresence,
    StartTracker,
    StopTracker,
    TrackFrame,
)
from share.protocol.peer import RestoredRun
from share.protocol.remote_tracking import TrackingEdge
from share.runtime.keyframe_handover import KeyframeHandover, KeyframesAdded
from share.runtime.map_writer import MapWriter
from share.runtime.mapper_process import RestoreMap, StartMapper
from share.runtime.mapper_supervision import MapperProgress, MapperRestarts
from share.runtime.room_parts import MapperLink, StartMapping
from share.runtime.tracker_processes import TrackerProcesses, tracker_capacity
from share.scheduling.policies import POLICIES

# without one of these, mapper and file would lack what later ones build on
SESSION_EFFECTS = AddKeyframe, AddRun, SetCredential, SetPresence, DropRun, SaveChanges
_DRAIN_S = 0.5  # wait for the map writer of a session that is over


@dataclass(frozen=True)
class MapNotice:
    """A line about the map file for the event log, from another thread."""

    text: str


@dataclass(frozen=True)
class MapperDied:
    """The mapper's process has died."""

    reason: str


@dataclass(frozen=True, eq=False)
class SessionParts:
    """What the sessions of one room have in common. post: takes answers, from any thread. start_ns: origin of
    the times in events. searches_for_others: the mapper also searches keyframes of other rooms' agents."""

    settings: Config
    start_ns: int
    post: Callable[[object], None]
    start_mapper: StartMapping
    searches_for_others: bool

    @property
    def streams_frames(self) -> bool:
        """Whether the edge tracks the agents' frames, without a map."""
        return POLICIES[self.settings.edge.policy].streams_frames


class RoomSession:
    """A session, until `end`."""

    def __init__(
        self,
        parts: SessionParts,
        restarts: MapperRestarts,
        restore: RestoreMap | None,
        known: Sequence[RestoredRun],
        start_delay_s: float = 0.0,
    ) -> None:
        """restore: the map that the mapper starts with. known: the agents' runs. start_delay_s: delay of the
        mapper's start. Raises what keeps a process or a thread from starting."""
        self._parts = parts
        self.progress = MapperProgress(start_delay_s)
        self.map_writer: MapWriter | None = None
        self.is_ended = False
        self.has_lost_changes = False  # since it has ended
        self._mapper: MapperLink | None = None
        self._trackers = TrackerProcesses(parts.settings, parts.post)
        self.state_machine: EdgeProtocol
        if parts.streams_frames:
            self.state_machine = TrackingEdge(
                parts.settings,
                secrets.randbits(63),
                began_ns=parts.start_ns,
                capacity=tracker_capacity(),
            )
        else:
            self._start_mapping(restarts, restore, known, start_delay_s)

    def _start_mapping(
        self,
        restarts: MapperRestarts,
        restore: RestoreMap | None,
        known: Sequence[RestoredRun],
        start_delay_s: float,
    ) -> None:
        store, parts = restarts.store, self._parts
        self.state_machine = EdgeProtocol(
            parts.settings,
            secrets.randbits(63),
            restarts.writable,
            known,
            parts.start_ns,
            restarts.objects or (),
            forgotten=restarts.forgotten,
        )
        if store is not None and restarts.writable:
            self.map_writer = MapWriter(store, parts.post, self._post_map_notice)
        try:
            self._mapper = parts.start_mapper(parts.post, self._post_mapper_died, start_delay_s)
            map_file = None if store is None else store.path
            self._mapper.send(StartMapper(parts.settings, map_file, parts.searches_for_others))
            if restore is not None:
                self._mapper.send(restore)
            self._handover = KeyframeHandover(self._mapper.send)
        except BaseException:
            self.end()
            raise

    @property
    def is_saved(self) -> bool:
        """Whether there is a map file and all is in it."""
        return self.map_writer is not None and not self.map_writer.pending_changes

    @property
    def troubles(self) -> list[str]:
        """Why changes cannot be saved now, and which process makes no progress; a line each."""
        unsaved = None if self.map_writer is None else self.map_writer.trouble
        stalled = None if self._mapper is None else self.progress.stall()
        return [text for text in (unsaved, stalled) if text is not None]

    def find(self, request: FindKeyframe) -> None:
        """Search a keyframe of another room's agent in the map."""
        if self._mapper is not None:
            self._mapper.send(request)

    def execute(self, effect: EdgeEffect) -> None:
        """Carry out an effect for mapper, map file or trackers; others are the room's."""
        match effect:
            case AddKeyframe() if self._mapper is not None:
                self._handover.add(effect)
            case AddRun() | SetCredential() | SetPresence() | DropRun() if self._mapper is not None:
                self._mapper.send(effect)
            case StartTracker() | TrackFrame() | StopTracker():
                self._trackers.execute(effect)
            case SaveChanges() if self.map_writer is not None:
                self.map_writer.submit(effect)
            case SaveChanges() if effect.changes:
                self.has_lost_changes = True

    def record_added(self, added: KeyframesAdded) -> None:
        """Record that the mapper has added keyframes: it is given more."""
        if self._mapper is not None:
            self._handover.record_added(added)

    def end_processes(self) -> None:
        """End all processes after they have answered all messages."""
        if self._mapper is not None:
            self._handover.flush()
            self._mapper.close()
        self._trackers.close()

    def end(self) -> bool:
        """End the mapper as it is, and write what is left. From then on nothing is applied or saved. Return
        False, and keep the writer, where the disk does not answer."""
        self.is_ended = True
        if self._mapper is not None:
            self._mapper.close()
            self._mapper = None
        if self.map_writer is not None:
            if not self.map_writer.drain(_DRAIN_S):
                return False
            self.map_writer = None
        return True

    def _post_map_notice(self, text: str) -> None:
        self._parts.post(MapNotice(text))

    def _post_mapper_died(self, reason: str) -> None:
        self._parts.post(MapperDied(reason))
