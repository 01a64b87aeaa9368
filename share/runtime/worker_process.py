"""A child process for heavy work, with queues in both directions."""

from __future__ import annotations

import contextlib
import queue
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from share import startup
from share.errors import brief_reason, describe_exception
from share.spawning import SPAWN_CONTEXT

Inbox = queue.SimpleQueue[Any]
Work = Callable[..., None]  # (inbox, answer, *arguments); returns when it takes END from the inbox
END = None
_TIMEOUT_S = 5.0


class WorkerProcess:
    """Runs `work(inbox, answer, *arguments)` in a spawned process, which ends when this process ends.

    `send` never waits. `on_answer` is called with each answer, from a thread; `on_death` once, from the same
    thread, if the process ends without being asked to. start_delay_s: delay of the start; messages sent
    meanwhile are kept. None: it is never started. Raises OSError and RuntimeError where files or threads are
    short.
    """

    def __init__(
        self,
        name: str,
        work: Work,
        arguments: tuple[Any, ...],
        on_answer: Callable[[Any], None],
        on_death: Callable[[str], None],
        start_delay_s: float | None = 0.0,
    ) -> None:
        self.name = name
        self._on_answer, self._on_death = on_answer, on_death
        self._attaching = threading.Lock()
        self._death_reason: str | None = None
        self._closing = threading.Event()
        self._starting = threading.Lock()
        self._start_error: str | None = None
        self._fault: str | None = None  # of this side, for which it was ended
        self._outbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._parent_end, self._child_end = SPAWN_CONTEXT.Pipe()
        self._process = SPAWN_CONTEXT.Process(
            target=_run_child, args=(self._child_end, work, arguments), name=name
        )
        if start_delay_s is not None and start_delay_s <= 0.0:
            self._start()
        sender = threading.Thread(target=self._send_loop, args=(start_delay_s,), daemon=True)
        receiver = threading.Thread(target=self._receive_loop, daemon=True)
        self._threads = list[threading.Thread]()
        for thread in (receiver, sender):
            try:
                thread.start()
            except RuntimeError:  # too many threads
                self._abandon()
                raise
            self._threads.append(thread)

    def _abandon(self) -> None:
        """End the process at once, which nobody can talk to."""
        self._closing.set()
        if self._process.pid is not None:
            self._process.kill()
            self._process.join()
        self._child_end.close()
        self._parent_end.close()

    @property
    def pid(self) -> int | None:
        """None before the start."""
        return self._process.pid

    def _start(self) -> None:
        """Start the process, unless it was closed before."""
        with self._starting:
            if not self._closing.is_set():
                try:
                    self._process.start()
                except (OSError, RuntimeError, MemoryError) as error:  # too many processes, or threads
                    self._start_error = getattr(error, "strerror", None) or brief_reason(error)
            self._child_end.close()

    @property
    def is_dead(self) -> bool:
        """Whether it has ended without being asked to."""
        return self._death_reason is not None

    def attach(self, on_answer: Callable[[Any], None], on_death: Callable[[str], None]) -> None:
        """Replace who gets the answers. A process that has died meanwhile is reported again."""
        with self._attaching:
            self._on_answer, self._on_death = on_answer, on_death
            reason = self._death_reason
        if reason is not None:
            on_death(reason)

    def send(self, message: Any) -> None:
        self._outbox.put(message)

    def close(self) -> None:
        """End the process after it has handled all messages; kill it after a few seconds."""
        with self._starting:
            self._closing.set()
        self._outbox.put(END)
        if self._process.pid is not None:
            self._process.join(_TIMEOUT_S)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()
        for thread in self._threads:
            thread.join(_TIMEOUT_S)
        self._parent_end.close()

    def _send_loop(self, start_delay_s: float | None) -> None:
        if start_delay_s is None or start_delay_s > 0.0:
            self._closing.wait(start_delay_s)
            self._start()
        while True:
            message = self._outbox.get()
            try:
                self._parent_end.send(message)
            except OSError:  # the process has died: `_receive_loop` reports it
                return
            except Exception as error:  # such as no memory: without this message it cannot go on
                self._end_at_fault(f"was ended: a message cannot be sent to it ({describe_exception(error)})")
                return
            if message is END:
                return

    def _receive_loop(self) -> None:
        try:
            while True:
                answer = self._parent_end.recv()
                self._on_answer(answer)  # of who waits now, see `attach`
        except (EOFError, OSError):
            pass
        except Exception as error:  # such as no memory: what follows would lack this answer
            self._end_at_fault(f"was ended: its answer cannot be read ({describe_exception(error)})")
        if not self._closing.is_set():
            self._outbox.put(END)
            reason = self._describe_exit()
            with self._attaching:
                self._death_reason, on_death = reason, self._on_death
            on_death(reason)

    def _end_at_fault(self, reason: str) -> None:
        """End the process for something on this side; `_receive_loop` reports it."""
        self._fault = self._fault or reason
        if self._process.pid is not None:
            self._process.kill()

    def _describe_exit(self) -> str:
        if self._start_error is not None:
            return f"could not be started: {self._start_error}"
        if self._fault is not None:
            return self._fault
        self._process.join(_TIMEOUT_S)
        code = self._process.exitcode
        if code is not None and code < 0:
            return f"was ended by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"


def _run_child(connection: Connection, work: Work, arguments: tuple[Any, ...]) -> None:
    """Entry point of the process."""
    startup.prepare_process()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # systemd sends it to all; the parent ends this process
    inbox: Inbox = queue.SimpleQueue()
    threading.Thread(target=_fill_inbox, args=(connection, inbox), daemon=True).start()
    with contextlib.suppress(BrokenPipeError):  # the parent is gone
        work(inbox, connection.send, *arguments)


def _fill_inbox(connection: Connection, inbox: Inbox) -> None:
    with contextlib.suppress(EOFError, OSError):
        while True:
            inbox.put(connection.recv())
    inbox.put(END)
