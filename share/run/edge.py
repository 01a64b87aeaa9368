"""The edge as a process: one receive loop that never computes and never waits for a disk.

link -> Edge (core) -> mapper's process (share.run.mapping) -> findings -> Edge -> link
                    -> keeper's thread (share.run.keeper)   -> what is safe -> acknowledgements
"""

from __future__ import annotations

import json
import os
import queue
import secrets
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from share.config import Config
from share.core.edge import Add, Edge, Effect, Event, Found, Join, Received, Record, Send, Tick
from share.io.files import atomic_write, check_writable, claim
from share.io.line_file import LineFile
from share.io.transport import EdgeLink
from share.run.companion import Companion
from share.run.mapping import Mapped, map_all

TICK_MS = 50
REFUSALS_SAID = 64  # strangers at the door; more are only counted
_AT_ONCE = 64  # messages, before anything else is looked after


class EdgeRun:
    """`go` runs until `stop`. In `out`: events.jsonl as things happen, edge.json at the end."""

    def __init__(
        self,
        settings: Config,
        link: EdgeLink,
        out: Path | None,
        tell: Callable[[dict[str, Any]], None],
    ) -> None:
        self._settings, self._link, self._tell = settings, link, tell
        self._inbox: queue.SimpleQueue[object] = queue.SimpleQueue()
        self._out = out
        self._claim: int | None = None
        self._events: LineFile | None = None
        if out is not None:
            check_writable(out / "edge.json")
            check_writable(out / "events.jsonl")
            self._claim = claim(out)
            self._events = LineFile(out / "events.jsonl", self._complain)
        self._stopping = False
        self._began_ns = time.monotonic_ns()
        self._refused: Counter[str] = Counter()  # handshakes, by what was said of them
        self._begin()

    def stop(self) -> None:
        """From any thread or a signal handler."""
        self._stopping = True
        self._link.wake()

    def go(self) -> dict[str, Any]:
        """The report, once stopped. Raises ShareError if it could not be written, or not all events."""
        try:
            while not self._stopping:
                self._step()
        finally:
            self._mapping.close()
            self._take_answers()
            self._link.close()
            report = self.report()
            self._finish(report)
        return report

    def report(self) -> dict[str, Any]:
        """As edge.json."""
        report = self._machine.report(self._mapped)
        return {**report, "refused_handshakes": self._refused.total()}

    def _begin(self) -> None:
        """A new life: agents notice by its number, and send again what it lacks."""
        self._machine = Edge(self._settings, secrets.randbits(63))
        self._mapped: dict[str, Any] = {}
        self._mapping = Companion("mapping", map_all, (self._settings,), self._answered, self._mapping_lost)

    def _finish(self, report: dict[str, Any]) -> None:
        if self._out is None or self._events is None or self._claim is None:
            return
        self._events.close()
        atomic_write(self._out / "edge.json", json.dumps(report, indent=2) + "\n")
        os.close(self._claim)
        self._events.check()

    # ------------------------------------------------------------------ the loop

    def _step(self) -> None:
        message = self._link.receive(TICK_MS)
        for _ in range(_AT_ONCE):
            if message is None:
                break
            self._handle(Received(*message))
            message = self._link.receive(0)
        for line in self._link.refusals():
            self._refuse(line)
        self._take_answers()
        self._handle(Tick())

    def _take_answers(self) -> None:
        while not self._inbox.empty():
            match self._inbox.get():
                case Found() as found:
                    self._handle(found)
                case Mapped() as mapped:
                    self._mapped = mapped.report
                case str() as how:
                    self._begin_anew(how)

    def _begin_anew(self, how: str) -> None:
        self._say("mapper lost", f"its process {how}; agents are asked for their keyframes again")
        self._mapping.close()
        self._begin()

    def _handle(self, event: Event) -> None:
        for effect in self._machine.handle(event, time.monotonic_ns()):
            self._carry_out(effect)

    def _carry_out(self, effect: Effect) -> None:
        match effect:
            case Send():
                self._link.send(effect.peer, effect.frames)
            case Join() | Add():
                self._mapping.send(effect)
            case Record():
                self._record(effect.fields)

    # ------------------------------------------------------------------ from other threads

    def _answered(self, message: object) -> None:
        self._inbox.put(message)
        self._link.wake()

    def _mapping_lost(self, how: str) -> None:
        self._answered(how)

    # ------------------------------------------------------------------ what is said

    def _record(self, fields: dict[str, Any]) -> None:
        if self._events is not None:
            self._events.write(json.dumps(fields))
        self._tell(fields)

    def _say(self, event: str, reason: str) -> None:
        t_s = round((time.monotonic_ns() - self._began_ns) * 1e-9, 6)
        self._record({"t_s": t_s, "event": event, "agent": None, "reason": reason})

    def _complain(self, text: str) -> None:
        self._tell({"t_s": 0.0, "event": "not written", "agent": None, "reason": text})

    def _refuse(self, line: str) -> None:
        """Counts a handshake that was refused; says each kind once, for a bounded number of kinds."""
        line = line if line in self._refused or len(self._refused) < REFUSALS_SAID else "and others"
        self._refused[line] += 1
        if self._refused[line] == 1:
            self._say("not let in", line)
