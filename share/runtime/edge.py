"""The edge process: one receive loop that never computes and never waits for a disk.

link -> Edge (protocol) -> mapper process (share.runtime.mapper_process) -> map events -> Edge -> link
                        -> map writer thread (share.runtime.map_writer) -> saved changes -> acknowledgements
                        -> output writer thread (share.runtime.output_writer) -> events.jsonl, edge.json
     or with policy `streamed`
link -> TrackingEdge -> a process per agent (share.runtime.tracker_processes) -> poses -> TrackingEdge -> link
"""

from __future__ import annotations

import queue
import secrets
import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from share.config import Config
from share.errors import StoreError
from share.event_kinds import EventKind
from share.net.transport import EdgeLink
from share.protocol.agent_health import trouble_lines
from share.protocol.common_events import Tick
from share.protocol.edge import EdgeProtocol
from share.protocol.edge_events import (
    AddKeyframe,
    AddRun,
    ChangesSaved,
    DropRun,
    EdgeEffect,
    EdgeEvent,
    MapperResult,
    PeerMessageReceived,
    SaveChanges,
    SendToPeer,
    SetCredential,
    SetPresence,
    StartTracker,
    StopTracker,
    TrackerAnswered,
    TrackerLost,
    TrackerReady,
    TrackFrame,
    WriteEvent,
)
from share.protocol.edge_records import SessionTotals
from share.protocol.peer import RestoredRun
from share.protocol.remote_tracking import TrackingEdge
from share.runtime.blinding import Blinding, NoBlinding
from share.runtime.edge_observer import EdgeObserver, EdgeObservers
from share.runtime.guarded_tracker import FaultGuard
from share.runtime.keyframe_handover import KeyframeHandover, KeyframesAdded
from share.runtime.map_writer import MapWriter
from share.runtime.mapper_process import MapperReport, MapRestored, RestoreMap, SolverDied, run_mapper
from share.runtime.mapper_supervision import TROUBLE_SHOWN_S, MapperProgress, MapperRestarts, RecentTroubles
from share.runtime.run_files import EdgeFiles
from share.runtime.tracker_processes import TrackerProcesses, tracker_capacity
from share.runtime.worker_process import WorkerProcess
from share.scheduling.policies import POLICIES
from share.startup import HeapTrimmer
from share.store.map_store import MapStore
from share.wire.room_messages import Permission

TICK_MS = 50
_REPORT_S = 0.1  # period of reports
_POSES_SHOWN_S, _REPORT_SHOWN_S = 0.05, 0.5  # periods of what an observer is shown at least
MAX_REFUSAL_KINDS = 64  # kinds of refused handshakes that are logged; more are only counted
_MAX_MESSAGES_PER_STEP = 64  # received before answers, ticks and reports get their turn
_STALE_REPORT_S = 1.0  # age from which a report is declared stale
_DRAIN_S = 0.5  # that the loop waits for the map writer of a session that is over


@dataclass(frozen=True)
class _Notice:
    """A line for the event log, from another thread."""

    event: EventKind
    text: str


@dataclass(frozen=True)
class _MapperDied:
    """The mapper's process has died."""

    reason: str


class EdgeRun:
    """One run of the edge, until `stop`. Writes events.jsonl as events happen and edge.json at the end to
    `out`. allowed: what every client may do where no keys say it. blinding: of a study."""

    def __init__(
        self,
        settings: Config,
        link: EdgeLink,
        out: Path | None,
        on_record: Callable[[dict[str, Any]], None],
        store: MapStore | None = None,
        observers: Sequence[EdgeObserver] = (),
        allowed: Collection[Permission] = (),
        blinding: Blinding | None = None,
    ) -> None:
        self._allowed, self._blinding = frozenset(allowed), blinding or NoBlinding()
        self._settings, self._link, self._on_record = settings, link, on_record
        self._observer = EdgeObservers(*observers)
        self._poses_shown_s = self._report_shown_s = 0.0  # to the observer, monotonic
        notify_map, has_keys = partial(self._log_event, "map"), link.agent_names("") is not None
        self._restarts = MapperRestarts(store, settings.merge.enter_m, notify_map, has_keys)
        self._restart_due_s: float | None = None  # when a session that waits for the disk starts
        self._restart_reason = ""
        self._inbox: queue.SimpleQueue[object] = queue.SimpleQueue()
        self._files = EdgeFiles(out, self._post_write_failure)
        self._stopping = self._closed = False
        self._incomplete_reason: str | None = None  # why the map file is incomplete at the end
        self._start_ns = time.monotonic_ns()
        self._refused_handshakes: Counter[str] = Counter()  # by refusal line
        self._troubles = RecentTroubles()
        self._other_troubles = RecentTroubles()  # of one agent or map, not of the edge
        self._report: dict[str, Any] = {}
        self._report_due_s = self._reported_s = 0.0  # next and last report, monotonic s
        self._heap = HeapTrimmer()
        self._totals = SessionTotals()
        self._guard = FaultGuard(lambda text: self._log_event("internal error", text))
        self._start_session(self._load_stored_map())

    def stop(self) -> None:
        """End the run. Safe from any thread and from a signal handler."""
        self._stopping = True
        self._link.wake()

    def run(self) -> dict[str, Any]:
        """Run until `stop` and return the report. Raises ShareError if the report, the events or the map
        could not be written completely."""
        try:
            while not self._stopping:
                self._step()
        finally:
            self.close()
            self._try_to_report()
            self._report["series"] = self._blinding.covered_series(self._state_machine.series())
            self._files.finish(self._report)
            self._discard_answers()
            self._files.check()
        if self._incomplete_reason is not None:
            raise StoreError(self._incomplete_reason)
        return self._report

    def close(self) -> None:
        """End all child processes and threads, also if `run` was never called. May be repeated."""
        self._stopping = True
        if self._closed:
            return
        self._closed = True
        if self._mapper_process is not None:
            self._handover.flush()
            self._mapper_process.close()
        self._handle_answers()
        self._trackers.close()
        if self._map_writer is not None:
            self._incomplete_reason = self._map_writer.close()
            self._handle_answers()  # acknowledges what has been saved
            if self._incomplete_reason is not None:
                self._log_event("map", self._incomplete_reason)
        self._link.close()

    def report(self) -> dict[str, Any]:
        """Return the contents of edge.json, at most 0.1 s old, with current problems as `trouble`. Safe from
        any thread."""
        report, late_s = self._report, time.monotonic() - self._reported_s - _REPORT_S
        if not report or late_s < _STALE_REPORT_S:
            return report
        stuck = f"the edge has been stuck for {late_s:.0f} s; all values shown are that old"
        return {**report, "trouble": [stuck, *report["trouble"]]}

    def _try_to_report(self) -> None:
        """Update the report. A failure costs this report, and `report` shows it as stale."""
        with self._guard.step("a report"):
            self._update_report()

    def _update_report(self) -> None:
        """Make a report and set when the next is due."""
        now = time.monotonic()
        self._report_due_s = now + _REPORT_S
        self._heap.trim_if_due(now)
        map_trouble = None if self._map_writer is None else self._map_writer.trouble
        current = (map_trouble, self._files.trouble, self._progress.stall(), self._link.trouble())
        report = self._totals.with_totals(self._state_machine.report(self._progress.report))
        report = self._blinding.covered(report)
        self._report = {
            **report,
            "refused": [*self._other_troubles.current(), *report["refused"]],
            "refused_handshakes": self._refused_handshakes.total(),
            "trouble": [*self._troubles.current(), *filter(None, current)],
            "degraded": self._restarts.losses,
            "agent_trouble": trouble_lines(report["agents"]),
            "uptime_s": round((time.monotonic_ns() - self._start_ns) * 1e-9, 3),
            **self._progress.last_solve(),
            **self._restarts.loading(),
        }
        self._reported_s = now

    def _load_stored_map(self) -> tuple[RestoreMap | None, list[RestoredRun]]:
        """Return the map and the agents' runs to start with. Raises StoreError if the map file is
        unreadable."""
        if POLICIES[self._settings.edge.policy].streams_frames:
            return None, []
        return self._restarts.load_map()

    def _start_session(
        self, loaded: tuple[RestoreMap | None, list[RestoredRun]], start_delay_s: float = 0.0
    ) -> None:
        """Start a new session: agents see its new number and resend what the map lacks.

        start_delay_s: delay of the mapper's start.
        """
        self._progress = MapperProgress()
        self._mapper_process: WorkerProcess | None = None
        self._map_writer: MapWriter | None = None
        self._trackers = TrackerProcesses(self._settings, self._post)
        self._handover: KeyframeHandover  # where there is a mapper
        self._state_machine: EdgeProtocol
        if POLICIES[self._settings.edge.policy].streams_frames:
            self._state_machine = TrackingEdge(
                self._settings, secrets.randbits(63), began_ns=self._start_ns, capacity=tracker_capacity()
            )
        else:
            self._start_mapping(*loaded, start_delay_s)
        self._link.expect_growth(loaded[0] is not None)  # until the mapper has it
        store = self._restarts.store
        self._observer.begin_session(None if store is None else store.path, loaded[1])

    def _start_mapping(
        self, restore: RestoreMap | None, known: list[RestoredRun], start_delay_s: float
    ) -> None:
        store, writable = self._restarts.store, self._restarts.writable
        session, objects = secrets.randbits(63), self._restarts.objects or ()
        self._state_machine = EdgeProtocol(self._settings, session, writable, known, self._start_ns, objects)
        arguments = (self._settings, None if store is None else store.path)
        self._mapper_process = WorkerProcess(
            "mapping", run_mapper, arguments, self._post, self._post_mapper_died, start_delay_s
        )
        if restore is not None:
            self._mapper_process.send(restore)
        self._handover = KeyframeHandover(self._mapper_process.send)
        if store is not None and writable:
            self._map_writer = MapWriter(store, self._post, self._post_map_notice)

    # ------------------------------------------------------------------ the loop

    def _step(self) -> None:
        has_news = False
        for i in range(_MAX_MESSAGES_PER_STEP):
            message = self._link.receive(0 if i else TICK_MS)
            if message is None:
                break
            has_news = True
            names = self._link.agent_names(message.key)
            may = self._allowed if names is None else self._link.permissions(message.key)
            self._handle(PeerMessageReceived(message.peer, message.frames, names, message.key, may))
        for line in self._link.refusals():
            self._count_refusal(line)
        self._handle_answers()
        self._handle(Tick())
        if self._restart_due_s is not None and time.monotonic() >= self._restart_due_s:
            self._restart_mapping(self._restart_reason)
        if time.monotonic() >= self._report_due_s:
            self._try_to_report()
        self._show_state(time.monotonic(), has_news)

    def _show_state(self, now_s: float, has_news: bool) -> None:
        """Show poses and report to the observer, where due; poses as soon as messages have come, too."""
        if self._observer.has_any and (has_news or now_s - self._poses_shown_s >= _POSES_SHOWN_S):
            self._poses_shown_s = now_s
            self._observer.add_poses(self._state_machine.latest_poses())
        if now_s - self._report_shown_s >= _REPORT_SHOWN_S:
            self._report_shown_s = now_s
            self._observer.add_report(self._report)

    def _handle_answers(self) -> None:
        while not self._inbox.empty():
            match self._inbox.get():
                case MapperResult() as result:
                    self._handle(result)
                    self._observer.add_result(result)
                case ChangesSaved() | TrackerReady() | TrackerAnswered() as answer:
                    self._handle(answer)
                case TrackerLost() as tracker if not self._stopping:
                    text = f"agent's run {tracker.key}: its tracker {tracker.reason}"
                    self._other_troubles.add(text)
                    self._handle(tracker)
                case KeyframesAdded() as added:
                    self._handover.record_added(added)
                case MapperReport() as report:
                    self._progress.record(report)
                case _Notice() as notice:
                    self._log_event(notice.event, notice.text)
                case MapRestored():
                    self._restarts.record_restored()
                    self._link.expect_growth(False)
                case SolverDied() as solver:
                    self._log_event("solver died", solver.text)
                    self._troubles.add(f"the solver: {solver.text}")
                case _MapperDied() as mapper if not self._stopping:
                    self._restart_mapping(f"its process {mapper.reason}")

    def _restart_mapping(self, reason: str) -> None:
        """Start a new session after the mapper died; to the agents this looks like a restart of the edge."""
        pause_s = self._restarts.record_death()
        text = f"{reason}; restarted in {pause_s:g} s; agents resend what is not in the map file"
        self._log_event("mapper died", text)
        self._troubles.add(f"the mapper: {text}", pause_s + TROUBLE_SHOWN_S)
        if self._mapper_process is not None:
            self._mapper_process.close()
        try:
            if self._map_writer is not None and not self._map_writer.drain(_DRAIN_S):
                raise StoreError("the disk of the map file does not answer")
            self._discard_answers()
            self._restarts.objects = self._state_machine.room.kept_objects()
            loaded = self._load_stored_map()
            report = self._state_machine.report(self._progress.report)
            self._totals.add_session(self._totals.with_totals(report))
            self._start_session(loaded, pause_s)
            self._restart_due_s = None
        except StoreError as error:  # until it can be read, nothing is applied or acknowledged
            self._log_event("map", f"{error}; retried in {pause_s:g} s")
            self._restart_due_s, self._restart_reason = time.monotonic() + pause_s, str(error)

    def _discard_answers(self) -> None:
        """Drop answers to a session that is over; log only its notices."""
        while not self._inbox.empty():
            match self._inbox.get():
                case _Notice() as notice:
                    self._log_event(notice.event, notice.text)

    def _handle(self, event: EdgeEvent) -> None:
        for effect in self._state_machine.handle(event, time.monotonic_ns()):
            self._execute(effect)

    def _execute(self, effect: EdgeEffect) -> None:
        if isinstance(effect, WriteEvent):
            fields = self._blinding.covered_event(effect.fields)
            if fields is None:
                return
            effect = WriteEvent(fields)
        self._observer.add_effect(effect)
        match effect:
            case SendToPeer():
                self._link.send(effect.peer_id, effect.frames)
            case AddKeyframe() if self._mapper_process is not None:
                self._handover.add(effect)
            case AddRun() | SetCredential() | SetPresence() | DropRun() if self._mapper_process is not None:
                self._mapper_process.send(effect)
            case StartTracker() | TrackFrame() | StopTracker():
                self._trackers.execute(effect)
            case SaveChanges() if self._map_writer is not None:
                self._map_writer.submit(effect)
            case WriteEvent():
                self._record(effect.fields)
                if effect.fields["event"] == "step failed" and effect.fields["agent"] is None:
                    self._other_troubles.add(effect.fields["reason"])

    # ------------------------------------------------------------------ from other threads

    def _post(self, message: object) -> None:
        self._inbox.put(message)
        self._link.wake()

    def _post_map_notice(self, text: str) -> None:
        self._post(_Notice("map", text))

    def _post_mapper_died(self, reason: str) -> None:
        self._post(_MapperDied(reason))

    # ------------------------------------------------------------------ log and report

    def _record(self, fields: dict[str, Any]) -> None:
        self._files.write_event(fields)
        self._on_record(fields)

    def _log_event(self, event: EventKind, reason: str) -> None:
        t_s = round((time.monotonic_ns() - self._start_ns) * 1e-9, 6)
        self._record({"t_s": t_s, "event": event, "agent": None, "reason": reason})

    def _post_write_failure(self, text: str) -> None:
        """Log that the disk does not take a file. Safe from any thread."""
        self._inbox.put(_Notice("write failed", text))

    def _count_refusal(self, line: str) -> None:
        """Count a refused handshake; log each kind once, up to MAX_REFUSAL_KINDS."""
        if line not in self._refused_handshakes and len(self._refused_handshakes) >= MAX_REFUSAL_KINDS:
            line = "further kinds of refusal, which are only counted"
        self._refused_handshakes[line] += 1
        if self._refused_handshakes[line] == 1:
            self._log_event("connection refused", line)
