"""One room that an edge serves: the state machine of its agents, its mapper, and the writer of its map file.

host (share.runtime.edge) -> EdgeProtocol
    -> mapper process (share.runtime.mapper_process) -> map events -> EdgeProtocol -> host
    -> map writer thread (share.runtime.map_writer) -> saved changes -> acknowledgements
or with policy `streamed`
host -> TrackingEdge -> a process per agent (share.runtime.tracker_processes) -> poses -> TrackingEdge -> host
"""

from __future__ import annotations

import queue
import time
from collections.abc import Mapping, Sequence
from typing import Any

from share.config import Config
from share.errors import StoreError, brief_reason, describe_exception
from share.event_kinds import EventKind
from share.mapping.places import FindKeyframe, KeyframeSought
from share.protocol.agent_health import trouble_lines
from share.protocol.common_events import Tick
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import (
    AddKeyframe,
    ChangesSaved,
    EdgeEffect,
    EdgeEvent,
    MapperResult,
    SendToPeer,
    TrackerAnswered,
    TrackerLost,
    TrackerReady,
    WriteEvent,
)
from share.protocol.edge_records import SessionTotals
from share.runtime.blinding import Blinding, NoBlinding
from share.runtime.edge_observer import EdgeObserver
from share.runtime.keyframe_handover import KeyframesAdded
from share.runtime.map_reading import MapRead, MapReading
from share.runtime.map_writer import CLOSE_S
from share.runtime.mapper_process import (
    MapperReport,
    MapRestored,
    PlaceNewsBatch,
    RestoreBegun,
    SolverDied,
    start_mapper_process,
)
from share.runtime.mapper_supervision import TROUBLE_SHOWN_S, MapperRestarts, RecentTroubles
from share.runtime.room_host import OtherRooms, RoomHost
from share.runtime.room_parts import RoomStore, StartMapping
from share.runtime.room_session import SESSION_EFFECTS, MapNotice, MapperDied, RoomSession, SessionParts

_NOTHING_YET = "nothing is mapped or acknowledged until that is done"


class ServedRoom:
    """A room, until `close`.

    start_ns: origin of the times in events. has_keys: agents have keys. totals: of the room's earlier
    sessions. Raises StoreError if the map in `store` is unreadable.
    """

    def __init__(
        self,
        settings: Config,
        host: RoomHost,
        start_ns: int,
        store: RoomStore | None,
        observer: EdgeObserver,
        blinding: Blinding | NoBlinding,
        has_keys: bool,
        others: OtherRooms | None = None,
        totals: SessionTotals | None = None,
        start_mapper: StartMapping = start_mapper_process,
    ) -> None:
        self._host = host
        self._observer, self._blinding, self._others = observer, blinding, others
        self._restarts = MapperRestarts(store, settings.merge.enter_m, self._log_map, has_keys)
        self._restart_due_s: float | None = None  # when a session that waits for the disk starts
        self._waiting_reason = ""  # why no session has started
        self._reading: MapReading | None = None  # the map, for the next session
        self._retry_s = 0.0  # pause before the next try to start a session
        self._mapper_due_s = 0.0  # when the next session's mapper may start, monotonic
        self._inbox: queue.SimpleQueue[object] = queue.SimpleQueue()
        self._stopping = False
        self._troubles = RecentTroubles()
        self._other_troubles = RecentTroubles()  # of one agent or map, not of the edge
        self._totals = totals or SessionTotals()
        self._parts = SessionParts(settings, start_ns, self._post, start_mapper, others is not None)
        self._session: RoomSession
        self._start_session()

    def handle(self, event: EdgeEvent) -> None:
        self.execute(self._session.state_machine.handle(event, time.monotonic_ns()))

    def step(self) -> None:
        """Handle the answers of the room's processes and threads, and the time that has passed."""
        self.handle_answers()
        self.handle(Tick())
        is_due = self._restart_due_s is not None and time.monotonic() >= self._restart_due_s
        if is_due and self._reading is None:
            self._restart_session(self._restarts.record_failure())

    def stop(self) -> None:
        """From now on the death of a process is expected. Safe from any thread and from a signal handler."""
        self._stopping = True

    def close(self) -> str | None:
        """End all processes and threads. Return why the map file is incomplete, None if it is complete."""
        self.end_processes()
        self.handle_answers()
        incomplete_reason = self.close_file()
        self.finish(incomplete_reason)
        return incomplete_reason

    # The parts of `close`, for a loop that must not wait: a thread calls the first and the third.

    def end_processes(self) -> None:
        """End all processes after they have answered all messages."""
        self._stopping = True
        self._session.end_processes()

    def handle_answers(self) -> None:
        """Handle the answers of the room's processes and threads."""
        while not self._inbox.empty():
            self._handle_answer(self._inbox.get())

    def close_file(self, timeout_s: float = CLOSE_S) -> str | None:
        """Close the map file; see `MapWriter.close`. Return why it is incomplete, None if it is complete."""
        if self._session.map_writer is not None:
            return self._session.map_writer.close(timeout_s)
        if not self.is_waiting:
            return None
        reason, store = self._waiting_reason, self._restarts.store
        if self._reading is not None:
            reason = self._reading.end(timeout_s, lambda problem: self._post(MapNotice(problem)))
        elif store is not None:  # unlock it
            store.close()
        if not reason and self._session.has_lost_changes:
            reason = "the edge ended before a new mapper began"
        return f"{reason}: keyframes not acknowledged are not in it" if reason else None

    def finish(self, incomplete_reason: str | None) -> None:
        """Acknowledge what has been saved at the end."""
        self.handle_answers()
        self._host.expect_growth(False)
        if incomplete_reason is not None:
            self._log_map(incomplete_reason)

    # ------------------------------------------------------------------ what other rooms need

    @property
    def protocol(self) -> EdgeProtocol:
        """The state machine of the present session; `execute` carries out what it returns."""
        return self._session.state_machine

    @property
    def is_idle(self) -> bool:
        """Whether nobody takes part, all is in the map file, and the mapper has nothing to do."""
        session = self._session
        has_no_work = session.progress.is_idle and not self._restarts.is_restoring
        return session.state_machine.is_empty and session.is_saved and has_no_work and not self.is_waiting

    @property
    def is_waiting(self) -> bool:
        """Whether the map cannot be read now, so that nobody may enter."""
        return self._restart_due_s is not None

    @property
    def loss(self) -> str | None:
        """What has happened to the machine of the map file and the mapper; None: it lives. A lost room does
        nothing more, and is to be closed and opened anew."""
        return None if self._restarts.store is None else self._restarts.store.loss

    def find(self, request: FindKeyframe) -> None:
        """Search a keyframe of another room's agent in the map."""
        self._session.find(request)

    def may_have_map(self, map_id: str) -> bool:
        """Return whether there may be a map of this name, by the mapper's newest report, if there is one."""
        report = self._session.progress.report
        return not report or map_id in report.get("maps", {}) or report.get("unlisted_maps", 0) > 0

    # ------------------------------------------------------------------ what is shown

    def show_poses(self) -> None:
        """Show the observer the newest pose of each present run."""
        self._observer.add_poses(self.protocol.latest_poses())

    def show_report(self, report: Mapping[str, Any]) -> None:
        """Show the observer edge.json as it is now."""
        self._observer.add_report(report)

    def series(self) -> Mapping[str, Mapping[str, Any]]:
        """Return `series` of edge.json."""
        return self._blinding.covered_series(self.protocol.series())

    def report(self) -> dict[str, Any]:
        """Return edge.json without `series` and what only the edge around the room knows."""
        report = self._blinding.covered(self._report_of(self._session))
        waiting = [self._waiting_reason] if self.is_waiting else []
        return {
            **report,
            "refused": [*self._other_troubles.current(), *report["refused"]],
            "trouble": [*self._troubles.current(), *waiting, *self._session.troubles],
            "degraded": self._restarts.losses,
            "agent_trouble": trouble_lines(report["agents"]),
            **self._session.progress.last_solve(),
            **({} if self.is_waiting else self._restarts.loading()),
        }

    def end_totals(self) -> SessionTotals:
        """Return the totals with those of the present session, at its end."""
        self._totals.add_session(self._report_of(self._session))
        return self._totals

    def _report_of(self, session: RoomSession) -> dict[str, Any]:
        return self._totals.with_totals(session.state_machine.report(session.progress.report))

    # ------------------------------------------------------------------ sessions

    def _start_session(self, read: MapRead | None = None) -> None:
        """Start a session with the map of the file. read: of it; None: it is read now. Raises StoreError if
        the file is unreadable, and what keeps a process or a thread from starting."""
        restore, known = (None, []) if self._parts.streams_frames else self._restarts.load_map(read)
        start_delay_s = max(0.0, self._mapper_due_s - time.monotonic())
        self._session = RoomSession(self._parts, self._restarts, restore, known, start_delay_s)
        if self._others is not None:
            self._others.note_session()
        self._host.expect_growth(restore is not None)  # until the mapper has it
        store = self._restarts.store
        self._observer.begin_session(None if store is None else store.path, known)

    def _on_mapper_death(self, reason: str) -> None:
        if not self._stopping and self.loss is None:
            self._restart_mapping("mapper died", f"its process {reason}", self._restarts.record_death())

    def _on_lost_effect(self, reason: str) -> None:
        """Go on without a change that mapper or map file need."""
        if self._stopping:
            self._log_map(f"a change is lost: {reason}")
        else:
            self._restart_mapping("map", f"it lacks a change ({reason})", self._restarts.record_failure())

    def _restart_mapping(self, event: EventKind, reason: str, pause_s: float) -> None:
        """Start a new session in place of one that cannot go on; to the agents this looks like a restart of
        the edge."""
        text = f"{reason}; restarted in {pause_s:g} s; agents resend what is not in the map file"
        self._host.log_event(event, text if event == "mapper died" else f"the mapper: {text}")
        self._troubles.add(f"the mapper: {text}", pause_s + TROUBLE_SHOWN_S)
        self._mapper_due_s = time.monotonic() + pause_s
        self._restart_session(pause_s)

    def _restart_session(self, retry_s: float) -> None:
        """End this session, read the map, and start a new one with it. Until then nothing is applied or
        acknowledged. retry_s: pause before the next try, if this one fails."""
        if self._reading is not None:  # a restart is under way
            return
        self._restart_due_s, self._retry_s = time.monotonic() + retry_s, retry_s
        try:
            if not self._session.is_ended:
                self._restarts.keep(self._session.state_machine)
            if not self._session.end():
                raise StoreError("the disk of the map file does not answer")
            self._discard_answers()
            if (store := self._restarts.store_to_read) is not None:
                self._waiting_reason = f"the map file is read; {_NOTHING_YET}"
                self._reading = MapReading(store, self._post)
            else:
                self._start_next_session(None)
        except Exception as error:  # the disk; too many open files, or threads
            self._on_failed_restart(error)

    def _start_next_session(self, read: MapRead | None) -> None:
        ended = self._session
        self._start_session(read)
        self._restart_due_s = None
        self._add_totals(ended)

    def _on_map_read(self, read: MapRead) -> None:
        self._reading = None
        try:
            self._start_next_session(read)
        except Exception as error:
            self._on_failed_restart(error)

    def _on_failed_restart(self, error: Exception) -> None:
        reason = brief_reason(error)
        self._waiting_reason = f"{reason}; {_NOTHING_YET}"
        self._restart_due_s = time.monotonic() + self._retry_s
        self._log_map(f"{reason}; retried in {self._retry_s:g} s")

    def _add_totals(self, ended: RoomSession) -> None:
        try:
            self._totals.add_session(self._report_of(ended))
        except Exception as error:  # they are for people
            self._host.log_event("internal error", f"totals of a session: {describe_exception(error)}")

    # ------------------------------------------------------------------ answers and effects

    def _handle_answer(self, answer: object) -> None:
        match answer:
            case MapperResult() as result:
                self.handle(result)
                self._observer.add_result(result)
            case ChangesSaved() | TrackerReady() | TrackerAnswered() as event:
                self.handle(event)
            case TrackerLost() as tracker if not self._stopping:
                text = f"agent's run {tracker.key}: its tracker {tracker.reason}"
                self._other_troubles.add(text)
                self.handle(tracker)
            case KeyframesAdded() as added:
                self._session.record_added(added)
            case MapperReport() as report:
                self._session.progress.record(report)
            case PlaceNewsBatch() as batch if self._others is not None:
                self._others.note_places(batch.news)
            case KeyframeSought() as sought if self._others is not None:
                self._others.note_sought(sought)
            case MapNotice() as notice:
                self._log_map(notice.text)
            case RestoreBegun():
                self._restarts.record_begun()
            case MapRestored():
                self._restarts.record_restored()
                self._host.expect_growth(False)
            case SolverDied() as solver:
                self._host.log_event("solver died", solver.text)
                self._troubles.add(f"the solver: {solver.text}")
            case MapRead() as read if not self._stopping:
                self._on_map_read(read)
            case MapperDied() as mapper:
                self._on_mapper_death(mapper.reason)

    def _discard_answers(self) -> None:
        """Drop answers to a session that is over; log only its notices."""
        while not self._inbox.empty():
            match self._inbox.get():
                case MapNotice() as notice:
                    self._log_map(notice.text)

    def execute(self, effects: Sequence[EdgeEffect]) -> None:
        """Carry out effects of the state machine. One that fails does not cost the others; without one that
        mapper or map file need, a new session begins. Raises the first error otherwise."""
        errors = list[Exception]()
        for effect in map(self._covered, effects):
            if effect is None:
                continue
            try:
                self._execute(effect)
            except Exception as error:
                if isinstance(effect, SESSION_EFFECTS):
                    self._on_lost_effect(describe_exception(error))
                    return
                errors.append(error)
            try:
                self._observer.add_effect(effect)
            except Exception as error:
                errors.append(error)
        if errors:
            raise errors[0]

    def _covered(self, effect: EdgeEffect) -> EdgeEffect | None:
        """Return an effect without what a study hides; None if it is hidden."""
        if not isinstance(effect, WriteEvent):
            return effect
        fields = self._blinding.covered_event(effect.fields)
        return None if fields is None else WriteEvent(fields)

    def _execute(self, effect: EdgeEffect) -> None:
        match effect:
            case SendToPeer():
                self._host.send(effect.peer_id, effect.frames)
            case WriteEvent():
                self._host.record(effect.fields)
                if effect.fields["event"] == "step failed" and effect.fields["agent"] is None:
                    self._other_troubles.add(effect.fields["reason"])
            case AddKeyframe() if self._others is not None:
                self._session.execute(effect)
                self._others.note_keyframe(effect)
            case _:
                self._session.execute(effect)

    def _log_map(self, reason: str) -> None:
        self._host.log_event("map", reason)

    # ------------------------------------------------------------------ from other threads

    def _post(self, message: object) -> None:
        self._inbox.put(message)
        self._host.wake()
