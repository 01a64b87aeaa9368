"""A process of our own that does heavy work while this one goes on."""

from __future__ import annotations

import contextlib
import queue
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from share import startup
from share.spawning import SPAWN

Inbox = queue.SimpleQueue[Any]
Work = Callable[..., None]  # (inbox, answer, *arguments); ends when it takes END from the inbox
END = None
_PATIENCE_S = 5.0


class Companion:
    """Runs `work(inbox, answer, *arguments)` in a spawned process.

    `send` never waits. Answers go to `heard`, from a thread; `lost` is called once, from that thread, if
    the process ends without being asked to. It ends with this one, however this one ends. after_s: it is
    started so much later, and gets then what was sent meanwhile (`share.rates`).
    """

    def __init__(
        self,
        name: str,
        work: Work,
        arguments: tuple[Any, ...],
        heard: Callable[[Any], None],
        lost: Callable[[str], None],
        after_s: float = 0.0,
    ) -> None:
        self.name = name
        self._heard, self._lost = heard, lost
        self._closing = threading.Event()
        self._starting = threading.Lock()
        self._obstacle: str | None = None  # why it could not be started
        self._outbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._ours, self._theirs = SPAWN.Pipe()
        self._process = SPAWN.Process(target=_begin, args=(self._theirs, work, arguments), name=name)
        if after_s <= 0.0:
            self._start()
        giving = threading.Thread(target=self._give, args=(after_s,), daemon=True)
        self._threads = [giving, threading.Thread(target=self._take, daemon=True)]
        for thread in self._threads:
            thread.start()

    @property
    def pid(self) -> int | None:
        """None before it is started."""
        return self._process.pid

    def _start(self) -> None:
        """Unless it was closed before it began."""
        with self._starting:
            if not self._closing.is_set():
                try:
                    self._process.start()
                except OSError as error:  # no memory, too many processes
                    self._obstacle = error.strerror or str(error)
            self._theirs.close()

    def send(self, message: Any) -> None:
        self._outbox.put(message)

    def close(self) -> None:
        """Everything sent is worked on first, but not for longer than a few seconds."""
        with self._starting:
            self._closing.set()
        self._outbox.put(END)
        if self._process.pid is not None:
            self._process.join(_PATIENCE_S)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()
        for thread in self._threads:
            thread.join(_PATIENCE_S)
        self._ours.close()

    def _give(self, after_s: float) -> None:
        if after_s > 0.0:
            self._closing.wait(after_s)
            self._start()
        while True:
            message = self._outbox.get()
            try:
                self._ours.send(message)
            except OSError:  # it has died: `_take` says so
                return
            if message is END:
                return

    def _take(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                self._heard(self._ours.recv())
        if not self._closing.is_set():
            self._outbox.put(END)
            self._lost(self._how())

    def _how(self) -> str:
        if self._obstacle is not None:
            return f"could not be started: {self._obstacle}"
        self._process.join(_PATIENCE_S)
        code = self._process.exitcode
        if code is not None and code < 0:
            return f"was ended by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"


def _begin(line: Connection, work: Work, arguments: tuple[Any, ...]) -> None:
    """The first thing that the process does."""
    startup.prepare()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # systemd sends it to all: the parent ends us in order
    inbox: Inbox = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(line, inbox), daemon=True).start()
    with contextlib.suppress(BrokenPipeError):  # the parent is gone
        work(inbox, line.send, *arguments)


def _listen(line: Connection, inbox: Inbox) -> None:
    with contextlib.suppress(EOFError, OSError):
        while True:
            inbox.put(line.recv())
    inbox.put(END)
