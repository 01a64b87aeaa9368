"""The edge process: one receive loop that never computes and never waits for a disk.

link -> ServedRoom (share.runtime.served_room), or several (share.runtime.site_rooms) -> link
                                               -> output writer thread (share.runtime.output_writer)
                                                  -> events.jsonl, edge.json
"""

from __future__ import annotations

import queue
import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

from share.config import Config
from share.errors import ShareError, StoreError, describe_exception
from share.event_kinds import EventKind
from share.net.transport import EdgeLink
from share.protocol.edge_events import PeerMessageReceived
from share.runtime.blinding import Blinding, NoBlinding
from share.runtime.edge_observer import EdgeObserver, EdgeObservers
from share.runtime.fault_guard import FaultGuard
from share.runtime.remote_room import RemoteRooms
from share.runtime.run_files import EdgeFiles
from share.runtime.served_room import ServedRoom
from share.runtime.site_rooms import RoomSetup, SiteRooms
from share.startup import HeapTrimmer
from share.store.map_store import MapStore
from share.wire.layouts import Bytes
from share.wire.room_messages import Permission

TICK_MS = 50
_REPORT_S = 0.1  # period of reports
_POSES_SHOWN_S, _REPORT_SHOWN_S = 0.05, 0.5  # periods of what an observer is shown at least
MAX_REFUSAL_KINDS = 64  # kinds of refused handshakes that are logged; more are only counted
_MAX_MESSAGES_PER_STEP = 64  # received before answers, ticks and reports get their turn
_STALE_REPORT_S = 1.0  # age from which a report is declared stale


class EdgeRun:
    """One run of the edge, until `stop`. Writes events.jsonl as events happen and edge.json at the end to
    `out`. allowed: rights of every client of an edge without keys. blinding: of a study."""

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
        rooms: Sequence[RoomSetup] = (),
        remote: RemoteRooms | None = None,
    ) -> None:
        """rooms: of a site, each with what is its own; then `settings`, `store` and `blinding` are of none.
        remote: see `SiteRooms`. Raises StoreError if a map is unreadable."""
        self._allowed, self._link, self._on_record = frozenset(allowed), link, on_record
        self._poses_shown_s = self._report_shown_s = 0.0  # to the observer, monotonic
        self._write_failures: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._files = EdgeFiles(out, self._write_failures.put)
        self._stopping = self._closed = False
        self._incomplete_reason: str | None = None  # why the map file is incomplete at the end
        self._start_ns = time.monotonic_ns()
        self._refused_handshakes: Counter[str] = Counter()  # by refusal line
        self._report: dict[str, Any] = {}
        self._report_due_s = self._reported_s = 0.0  # next and last report, monotonic s
        self._report_failure: str | None = None  # why the last one could not be made
        self._heap = HeapTrimmer()
        self._guard = FaultGuard(lambda text: self.log_event("internal error", text))
        has_keys = link.agent_names("") is not None
        self._has_observers = bool(observers or rooms)
        self._room: ServedRoom | SiteRooms
        if rooms:
            self._room = SiteRooms(self, rooms, self._start_ns, has_keys, remote=remote)
        else:
            self._room = ServedRoom(
                settings,
                self,
                self._start_ns,
                store,
                EdgeObservers(*observers),
                blinding or NoBlinding(),
                has_keys,
            )

    def stop(self) -> None:
        """End the run. Safe from any thread and from a signal handler."""
        self._stopping = True
        self._room.stop()
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
            self._report["series"] = self._room.series()
            self._files.finish(self._report)
            self._log_write_failures()
            self._files.check()
        if self._incomplete_reason is not None:
            raise StoreError(self._incomplete_reason)
        if self._report_failure is not None:
            raise ShareError(f"edge.json is not of the end: {self._report_failure}")
        return self._report

    def close(self) -> None:
        """End all child processes and threads, also if `run` was never called. May be repeated."""
        self._stopping = True
        if self._closed:
            return
        self._closed = True
        self._incomplete_reason = self._room.close()
        self._link.close()

    def report(self) -> dict[str, Any]:
        """Return the contents of edge.json, at most 0.1 s old, with current problems as `trouble`. Safe from
        any thread."""
        report, late_s = self._report, time.monotonic() - self._reported_s - _REPORT_S
        if not report or late_s < _STALE_REPORT_S:
            return report
        cause = self._report_failure or "the edge has been stuck"
        stuck = f"{cause}: all values shown are {late_s:.0f} s old"
        return {**report, "trouble": [stuck, *report["trouble"]]}

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
            with self._guard.step("a message"):
                self._room.handle(PeerMessageReceived(message.peer, message.frames, names, message.key, may))
        for line in self._link.refusals():
            self._count_refusal(line)
        self._log_write_failures()
        with self._guard.step("a step of the room"):
            self._room.step()
        if time.monotonic() >= self._report_due_s:
            self._try_to_report()
        self._show_state(time.monotonic(), has_news)

    def _try_to_report(self) -> None:
        """Update the report. A failure costs this report, and `report` says so."""
        try:
            self._update_report()
            self._report_failure = None
        except Exception as error:
            self._report_failure = f"no report can be made ({describe_exception(error)})"
            self._guard.record("a report", error)

    def _update_report(self) -> None:
        """Make a report and set when the next is due."""
        now = time.monotonic()
        self._report_due_s = now + _REPORT_S
        self._heap.trim_if_due(now)
        report = self._room.report()
        troubles = self._guard.trouble, self._files.trouble, self._link.trouble()
        self._report = {
            **report,
            "refused_handshakes": self._refused_handshakes.total(),
            "trouble": [*report["trouble"], *filter(None, troubles)],
            "uptime_s": round((time.monotonic_ns() - self._start_ns) * 1e-9, 3),
        }
        self._reported_s = now

    def _show_state(self, now_s: float, has_news: bool) -> None:
        """Show poses and report to the observer, where due; poses as soon as messages have come, too."""
        if self._has_observers and (has_news or now_s - self._poses_shown_s >= _POSES_SHOWN_S):
            self._poses_shown_s = now_s
            self._room.show_poses()
        if now_s - self._report_shown_s >= _REPORT_SHOWN_S:
            self._report_shown_s = now_s
            self._room.show_report(self._report)

    # ------------------------------------------------------------------ the room's host

    def wake(self) -> None:
        """Have the loop look for answers of the room. Safe from any thread."""
        self._link.wake()

    def send(self, peer_id: bytes, frames: Sequence[Bytes]) -> None:
        self._link.send(peer_id, frames)

    def expect_growth(self, is_expected: bool) -> None:
        self._link.expect_growth(is_expected)

    def record(self, fields: dict[str, Any]) -> None:
        """Write an event to events.jsonl and show it."""
        self._files.write_event(fields)
        self._on_record(fields)

    def log_event(self, event: EventKind, reason: str) -> None:
        t_s = round((time.monotonic_ns() - self._start_ns) * 1e-9, 6)
        self.record({"t_s": t_s, "event": event, "agent": None, "reason": reason})

    def _log_write_failures(self) -> None:
        """Log that the disk does not take a file, as the output writer's thread found."""
        while not self._write_failures.empty():
            self.log_event("write failed", self._write_failures.get())

    def _count_refusal(self, line: str) -> None:
        """Count a refused handshake; log each kind once, up to MAX_REFUSAL_KINDS."""
        if line not in self._refused_handshakes and len(self._refused_handshakes) >= MAX_REFUSAL_KINDS:
            line = "further kinds of refusal, which are only counted"
        self._refused_handshakes[line] += 1
        if self._refused_handshakes[line] == 1:
            self.log_event("connection refused", line)
