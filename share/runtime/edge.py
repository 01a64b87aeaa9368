"""The edge as a process: one receive loop that never computes and never waits for a disk.

link -> Edge (core) -> mapper's process (share.runtime.mapper) -> findings -> Edge -> link
                    -> keeper's thread (share.runtime.keeper)   -> what is safe -> acknowledgements
                    -> scribe's thread (share.runtime.scribe)   -> events.jsonl, edge.json
     or by policy `streamed`
link -> TrackingEdge -> a process each (share.runtime.tracking) -> poses -> TrackingEdge -> link
"""

from __future__ import annotations

import json
import os
import queue
import secrets
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from share.config import Config
from share.errors import StoreError
from share.files.line_file import LineFile
from share.files.writing import atomic_write, check_replaceable, claim
from share.mapping.changes import Kept as KeptMap
from share.net.transport import EdgeLink
from share.protocol.edge import Edge
from share.protocol.edge_events import (
    Add,
    Answered,
    BeginTracking,
    Effect,
    EndTracking,
    Event,
    Forget,
    Found,
    Join,
    Keep,
    Kept,
    Lost,
    Present,
    Ready,
    Received,
    Record,
    Send,
    Speaks,
    Tick,
    Track,
)
from share.protocol.edge_records import Totals
from share.protocol.peer import Known
from share.protocol.remote_tracking import TrackingEdge
from share.runtime.guarded_tracker import Guard
from share.runtime.keeper import Keeper
from share.runtime.mapper import Mapped, Restore, Restored, SolverLost, map_all
from share.runtime.restarts import Restarts
from share.runtime.scribe import Scribe
from share.runtime.tracking import Trackers, room
from share.runtime.worker import Companion
from share.scheduling.policies import POLICIES
from share.startup import Heap
from share.store.map_store import MapStore

TICK_MS = 50
_REPORT_S = 0.1  # so that what is shown of agents is true within a second
_UNWELL_S = 10.0  # how long a death is trouble
REFUSALS_SAID = 64  # strangers at the door; more are only counted
_AT_ONCE = 64  # messages, before anything else is looked after
_MUTE_S = 5.0  # of the mapper, which says something every second
_SOLVING_S = 15.0  # of one solution
_STUCK_S = 1.0  # without a report: what is shown is no longer true
_DRAIN_S = 0.5  # that the loop waits for the keeper of a life that is over


@dataclass(frozen=True)
class _Said:
    """By another thread, for a person."""

    event: str
    text: str


@dataclass(frozen=True)
class _MapperLost:
    """The mapper's process has died."""

    how: str


class EdgeRun:
    """`go` runs until `stop`. In `out`: events.jsonl as things happen, edge.json at the end."""

    def __init__(
        self,
        settings: Config,
        link: EdgeLink,
        out: Path | None,
        tell: Callable[[dict[str, Any]], None],
        store: MapStore | None = None,
    ) -> None:
        self._settings, self._link, self._tell = settings, link, tell
        has_keys = link.names("") is not None
        said = partial(self._say, "map")
        self._restarts = Restarts(store, settings.merge.enter_m, said, has_keys)
        self._begin_at: float | None = None  # a life that waits for the disk
        self._waits_for = ""
        self._inbox: queue.SimpleQueue[object] = queue.SimpleQueue()
        self._out = out
        self._claim: int | None = None
        self._events: LineFile | None = None
        self._scribe: Scribe | None = None
        if out is not None:
            check_replaceable(out / "edge.json")
            check_replaceable(out / "events.jsonl")
            self._claim = claim(out)
            self._events = LineFile(out / "events.jsonl", self._complain)
            self._scribe = Scribe(out, self._complain)
        self._stopping = self._closed = False
        self._incomplete: str | None = None  # the map's file, at the end
        self._began_ns = time.monotonic_ns()
        self._refused: Counter[str] = Counter()  # handshakes, by what was said of them
        self._trouble: dict[str, float] = {}  # what to say until when
        self._of_agents: dict[str, float] = {}  # the same, where it is one agent's alone
        self._report: dict[str, Any] = {}
        self._report_at = self._noted_at = 0.0  # when the next is due, and when there was one last
        self._heap = Heap()
        self._totals = Totals()
        self._guard = Guard(lambda text: self._say("internal error", text))
        self._begin(self._found())

    def stop(self) -> None:
        """From any thread or a signal handler."""
        self._stopping = True
        self._link.wake()

    def go(self) -> dict[str, Any]:
        """The report, once stopped. Raises ShareError if it could not be written, or not all events, or not
        all of the map."""
        try:
            while not self._stopping:
                self._step()
        finally:
            self.close()
            self._try_to_note()
            self._report["series"] = self._machine.series()
            self._finish(self._report)
        if self._incomplete is not None:
            raise StoreError(self._incomplete)
        return self._report

    def close(self) -> None:
        """Ends the processes and threads it has started, also where it never came to `go`. May be
        repeated."""
        self._stopping = True
        if self._closed:
            return
        self._closed = True
        if self._mapping is not None:
            self._mapping.close()
        self._take_answers()
        self._trackers.close()
        if self._keeper is not None:
            self._incomplete = self._keeper.close()
            self._take_answers()  # what is safe by now is acknowledged
            if self._incomplete is not None:
                self._say("map", self._incomplete)
        self._link.close()

    def report(self) -> dict[str, Any]:
        """As edge.json, 0.1 s old, and `trouble`: what is wrong now. From any thread."""
        report, late_s = self._report, time.monotonic() - self._noted_at - _REPORT_S
        if not report or late_s < _STUCK_S:
            return report
        stuck = f"the edge has been stuck for {late_s:.0f} s; what is shown of agents is as old as that"
        return {**report, "trouble": [stuck, *report["trouble"]]}

    def _try_to_note(self) -> None:
        """A fault of ours costs this report, which is then shown to be old."""
        with self._guard.step("a report"):
            self._note()

    def _note(self) -> None:
        """A report, and when the next is due."""
        now = time.monotonic()
        self._report_at = now + _REPORT_S
        self._heap.tidy(now)
        disks = [writer.trouble for writer in (self._keeper, self._scribe) if writer is not None]
        standing = [*disks, self._standstill(now), self._link.trouble()]
        self._trouble = {text: until for text, until in self._trouble.items() if now < until}
        self._of_agents = {text: until for text, until in self._of_agents.items() if now < until}
        report = self._totals.added(self._machine.report(self._mapped))
        self._report = {
            **report,
            "refused": [*self._of_agents, *report["refused"]],
            "refused_handshakes": self._refused.total(),
            "trouble": [*self._trouble, *(text for text in standing if text is not None)],
            "uptime_s": round((time.monotonic_ns() - self._began_ns) * 1e-9, 3),
            **({} if self._solved_at is None else {"last_solve_s": round(now - self._solved_at, 3)}),
        }
        self._noted_at = now

    def _standstill(self, now: float) -> str | None:
        """Which process does not go on though it is alive, if one does not."""
        if self._mapping is None or self._mapped_at is None:
            return None
        if (mute_s := now - self._mapped_at) > _MUTE_S:
            return f"the mapper has not answered for {mute_s:.0f} s: no corrections meanwhile"
        if (solving_s := self._solving_s + mute_s) > _SOLVING_S:
            return f"the solver has been at one solution for {solving_s:.0f} s: no corrections meanwhile"
        return None

    def _found(self) -> tuple[KeptMap | None, list[Known]]:
        """What a new life begins with. Raises StoreError if the map's file cannot be read."""
        return (None, []) if POLICIES[self._settings.edge.policy].raw else self._restarts.found()

    def _begin(self, found: tuple[KeptMap | None, list[Known]], after_s: float = 0.0) -> None:
        """A new life: agents notice by its number, and send again what it lacks.

        after_s: its mapper begins then.
        """
        self._mapped: dict[str, Any] = {}
        self._solved_at: float | None = None
        self._mapped_at: float | None = None  # when the mapper last said something
        self._solving_s = 0.0  # at that time
        self._mapping: Companion | None = None
        self._keeper: Keeper | None = None
        self._trackers = Trackers(self._settings, self._answered)
        self._machine: Edge
        if POLICIES[self._settings.edge.policy].raw:
            self._machine = TrackingEdge(
                self._settings, secrets.randbits(63), began_ns=self._began_ns, room=room()
            )
        else:
            self._begin_mapping(*found, after_s)

    def _begin_mapping(self, kept: KeptMap | None, known: list[Known], after_s: float) -> None:
        store, writable = self._restarts.store, self._restarts.writable
        self._machine = Edge(self._settings, secrets.randbits(63), writable, known, self._began_ns)
        about = (self._settings,)
        self._mapping = Companion("mapping", map_all, about, self._answered, self._mapping_lost, after_s)
        if kept is not None:
            self._mapping.send(Restore(kept))
        if store is not None and writable:
            self._keeper = Keeper(store, self._answered, self._map_said)

    def _finish(self, report: dict[str, Any]) -> None:
        if self._out is None or self._events is None or self._claim is None or self._scribe is None:
            return
        self._scribe.do(self._events.close)
        self._scribe.do(partial(atomic_write, self._out / "edge.json", json.dumps(report, indent=2) + "\n"))
        self._scribe.end()
        self._forget_answers()
        self._scribe.check()
        os.close(self._claim)
        self._events.check()

    # ------------------------------------------------------------------ the loop

    def _step(self) -> None:
        for i in range(_AT_ONCE):
            message = self._link.receive(0 if i else TICK_MS)
            if message is None:
                break
            names = self._link.names(message.key)
            self._handle(Received(message.peer, message.frames, names, message.key))
        for line in self._link.refusals():
            self._refuse(line)
        self._take_answers()
        self._handle(Tick())
        if self._begin_at is not None and time.monotonic() >= self._begin_at:
            self._begin_anew(self._waits_for)
        if time.monotonic() >= self._report_at:
            self._try_to_note()

    def _take_answers(self) -> None:
        while not self._inbox.empty():
            match self._inbox.get():
                case Found() as found:
                    self._handle(found)
                case Kept() | Ready() | Answered() as answer:
                    self._handle(answer)
                case Lost() as lost if not self._stopping:
                    text = f"agent's run {lost.key}: its tracker {lost.how}"
                    self._of_agents[text] = time.monotonic() + _UNWELL_S
                    self._handle(lost)
                case Mapped() as mapped:
                    if _solved(mapped.report) > _solved(self._mapped):
                        self._solved_at = time.monotonic()
                    self._mapped = mapped.report
                    self._mapped_at, self._solving_s = time.monotonic(), mapped.solving_s
                case _Said() as said:
                    self._say(said.event, said.text)
                case Restored():
                    self._restarts.restored()
                case SolverLost() as solver:
                    self._say("solver lost", solver.text)
                    self._trouble[f"the solver: {solver.text}"] = time.monotonic() + _UNWELL_S
                case _MapperLost() as gone if not self._stopping:
                    self._begin_anew(f"its process {gone.how}")

    def _begin_anew(self, how: str) -> None:
        """The mapper has died: as if the whole edge had been restarted, to its agents too."""
        pause_s = self._restarts.died()
        text = f"{how}; a new one begins in {pause_s:g} s; agents are asked for what is not in the map's file"
        self._say("mapper lost", text)
        self._trouble[f"the mapper: {text}"] = time.monotonic() + pause_s + _UNWELL_S
        if self._mapping is not None:
            self._mapping.close()
        try:
            if self._keeper is not None and not self._keeper.drain(_DRAIN_S):
                raise StoreError("the map's disk does not answer")
            self._forget_answers()
            found = self._found()
            self._totals.ended(self._totals.added(self._machine.report(self._mapped)))
            self._begin(found, pause_s)
            self._begin_at = None
        except StoreError as error:  # nothing is taken in or acknowledged until it can be read
            self._say("map", f"{error}; tried again in {pause_s:g} s")
            self._begin_at, self._waits_for = time.monotonic() + pause_s, str(error)

    def _forget_answers(self) -> None:
        """Those of the mapper and keeper of a life that is over are no answers to the next."""
        while not self._inbox.empty():
            match self._inbox.get():
                case _Said() as said:
                    self._say(said.event, said.text)

    def _handle(self, event: Event) -> None:
        for effect in self._machine.handle(event, time.monotonic_ns()):
            self._carry_out(effect)

    def _carry_out(self, effect: Effect) -> None:
        match effect:
            case Send():
                self._link.send(effect.peer, effect.frames)
            case Join() | Speaks() | Present() | Add() | Forget() if self._mapping is not None:
                self._mapping.send(effect)
            case BeginTracking() | Track() | EndTracking():
                self._trackers.do(effect)
            case Keep() if self._keeper is not None:
                self._keeper.keep(effect)
            case Record():
                self._record(effect.fields)

    # ------------------------------------------------------------------ from other threads

    def _answered(self, message: object) -> None:
        self._inbox.put(message)
        self._link.wake()

    def _map_said(self, text: str) -> None:
        self._answered(_Said("map", text))

    def _mapping_lost(self, how: str) -> None:
        self._answered(_MapperLost(how))

    # ------------------------------------------------------------------ what is said

    def _record(self, fields: dict[str, Any]) -> None:
        if self._events is not None and self._scribe is not None:
            self._scribe.do(partial(self._events.write, json.dumps(fields)))
        self._tell(fields)

    def _say(self, event: str, reason: str) -> None:
        t_s = round((time.monotonic_ns() - self._began_ns) * 1e-9, 6)
        self._record({"t_s": t_s, "event": event, "agent": None, "reason": reason})

    def _complain(self, text: str) -> None:
        """From any thread."""
        self._inbox.put(_Said("not written", text))

    def _refuse(self, line: str) -> None:
        """Counts a handshake that was refused; says each kind once, for a bounded number of kinds."""
        line = line if line in self._refused or len(self._refused) < REFUSALS_SAID else "and others"
        self._refused[line] += 1
        if self._refused[line] == 1:
            self._say("not let in", line)


def _solved(mapped: Mapping[str, Any]) -> int:
    """How often poses were solved for, by the mapper's report."""
    return int(mapped.get("solve_ms", {}).get("n", 0))
