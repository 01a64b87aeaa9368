"""The edge as a process: one receive loop that never computes, and one worker that does."""

from __future__ import annotations

import json
import queue
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from share.config import Config
from share.core.edge import Done, Edge, Effect, Event, Received, Record, Send, Tick, Work
from share.io.files import atomic_write, writable_dir
from share.io.transport import EdgeLink
from share.run.worker import Worker

TICK_MS = 50


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
        self._out = None if out is None else writable_dir(out)
        self._events: IO[str] | None = None
        self._stopping = False
        if self._out is not None:
            self._events = (self._out / "events.jsonl").open("w", buffering=1)

    def stop(self) -> None:
        """From any thread or a signal handler."""
        self._stopping = True
        self._link.wake()

    def go(self) -> dict[str, Any]:
        """The report, once stopped."""
        try:
            while not self._stopping:
                self._step()
        finally:
            self._worker.close()
            self._link.close()
            report = self._machine.report()
            if self._events is not None:
                self._events.close()
            if self._out is not None:
                atomic_write(self._out / "edge.json", json.dumps(report, indent=2) + "\n")
        return report

    def _step(self) -> None:
        message = self._link.receive(TICK_MS)
        if message is not None:
            self._handle(Received(*message))
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
                if self._events is not None:
                    self._events.write(json.dumps(effect.fields) + "\n")
                self._tell(effect.fields)

    def _done(self, done: Done) -> None:
        self._inbox.put(done)
        self._link.wake()
