"""The edge as a process: one receive loop that never computes, and one worker that does."""

from __future__ import annotations

import json
import os
import queue
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from share.config import Config
from share.core.edge import Done, Edge, Effect, Event, Received, Record, Send, Tick, Work
from share.io.files import atomic_write, check_writable, claim
from share.io.line_file import LineFile
from share.io.transport import EdgeLink
from share.run.worker import Worker

TICK_MS = 50
REFUSALS_SAID = 64  # strangers at the door; more are only counted


class EdgeRun:
    """`go` runs until `stop`. In `out`: events.jsonl as things happen, edge.json at the end."""

    def __init__(
        self,
        settings: Config,
        session: int,
        link: EdgeLink,
        out: Path | None,
        tell: Callable[[dict[str, Any]], None],
    ) -> None:
        self._link, self._tell = link, tell
        self._machine = Edge(settings, session)
        self._inbox: queue.SimpleQueue[Done] = queue.SimpleQueue()
        self._worker = Worker(self._done)
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
            self._worker.close()
            self._link.close()
            report = {**self._machine.report(), "refused_handshakes": self._refused.total()}
            self._finish(report)
        return report

    def _finish(self, report: dict[str, Any]) -> None:
        if self._out is None or self._events is None or self._claim is None:
            return
        self._events.close()
        atomic_write(self._out / "edge.json", json.dumps(report, indent=2) + "\n")
        os.close(self._claim)
        self._events.check()

    def _complain(self, text: str) -> None:
        self._tell({"t_s": 0.0, "event": "not written", "agent": None, "reason": text})

    def _step(self) -> None:
        message = self._link.receive(TICK_MS)
        if message is not None:
            self._handle(Received(*message))
        for line in self._link.refusals():
            self._refuse(line)
        while not self._inbox.empty():
            self._handle(self._inbox.get())
        self._handle(Tick())

    def _handle(self, event: Event) -> None:
        for effect in self._machine.handle(event, time.monotonic_ns()):
            self._carry_out(effect)

    def _carry_out(self, effect: Effect) -> None:
        match effect:
            case Send():
                self._link.send(effect.peer, effect.frames)
            case Work():
                self._worker.give(effect.job)
            case Record():
                self._record(effect.fields)

    def _record(self, fields: dict[str, Any]) -> None:
        if self._events is not None:
            self._events.write(json.dumps(fields))
        self._tell(fields)

    def _refuse(self, line: str) -> None:
        """Counts a handshake that was refused; says each kind once, for a bounded number of kinds."""
        line = line if line in self._refused or len(self._refused) < REFUSALS_SAID else "and others"
        self._refused[line] += 1
        if self._refused[line] == 1:
            t_s = round((time.monotonic_ns() - self._began_ns) * 1e-9, 6)
            self._record({"t_s": t_s, "event": "not let in", "agent": None, "reason": line})

    def _done(self, done: Done) -> None:
        self._inbox.put(done)
        self._link.wake()
