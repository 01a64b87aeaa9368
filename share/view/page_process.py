"""A process that serves a page to browsers, started and watched by the process that the page is about.

It ends with the process that started it, which it can neither hold up nor end. That one starts it again if it
ends by itself, and ends it if its heartbeat stops or it grows too large.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from typing import Any

from share.net import tcp
from share.spawning import SPAWN_CONTEXT
from share.timing import Backoff
from share.view.feed import ViewFeed

HEARTBEAT = b""
REPORT = b"{"  # begins a message of the process, a JSON object; else it is its last words
MAX_LAST_WORDS = 200  # characters
LOOK_S = 1.0  # between looks at the process, and between its heartbeats
MAX_SILENT_LOOKS = 30  # in a row without a heartbeat: it hangs
_MAX_START_LOOKS = 120  # before the first one: it has a low priority
MAX_BYTES = 2**30  # of its memory
_MAX_MESSAGE_BYTES = 2**16
_STOP_S = 2.0
_HEALTHY_NS = 60_000_000_000  # one that ran for so long waits 1 s again before its next start


class PageProcess:
    """A process, and the pipe to it. `close` may be repeated.

    title: in lines for a person. entry: called in the process with its end of the pipe and `arguments`.
    notify: is called with a line, from another thread, if the process ends by itself or hangs. on_start: is
    called with this end of the pipe whenever it has started. on_report: with each message of the process that
    begins with REPORT, from another thread.
    """

    def __init__(
        self,
        title: str,
        entry: Callable[..., None],
        arguments: tuple[Any, ...],
        notify: Callable[[str], None],
        on_start: Callable[[Connection], None],
        on_report: Callable[[bytes], None] = lambda data: None,
    ) -> None:
        self._title, self._entry, self._arguments = title, entry, arguments
        self._notify, self._on_start, self._on_report = notify, on_start, on_report
        self._closing = threading.Event()
        self._start()
        self._watcher = threading.Thread(target=self._watch, name=f"{title} watch", daemon=True)
        self._watcher.start()

    @property
    def pid(self) -> int | None:
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """Whether there is a process that serves the page, or will in a moment."""
        return self._is_alive

    def close(self) -> None:
        """Wait for the process, which has been told to end; end it if it does not."""
        self._closing.set()
        self._watcher.join(_STOP_S)
        if self._watcher.is_alive():
            self._process.kill()
            self._watcher.join()

    def announce_end(self) -> None:
        """Say that an end of the process is meant from now on."""
        self._closing.set()

    def _start(self) -> None:
        """Raises OSError if the system is out of processes, memory or file descriptors."""
        self._connection, child_end = SPAWN_CONTEXT.Pipe()
        self._process = SPAWN_CONTEXT.Process(
            target=self._entry, args=(child_end, *self._arguments), name=self._title, daemon=True
        )
        self._process.start()
        child_end.close()
        self._is_alive = True
        self._on_start(self._connection)

    # ------------------------------------------------------------------ the watching thread

    def _watch(self) -> None:
        backoff = Backoff(time.monotonic_ns(), _HEALTHY_NS)
        while True:
            why = self._wait_for_end()
            if self._closing.is_set():
                return
            delay_s = backoff.record_failure(time.monotonic_ns())
            self._notify(f"the {self._title} has ended ({why}) and starts again in {delay_s:.0f} s")
            if self._closing.wait(delay_s):
                return
            try:
                self._start()
            except OSError as error:
                self._notify(
                    f"the {self._title} cannot start again: {error.strerror}; the edge goes on without it"
                )
                return

    def _wait_for_end(self) -> str:
        """Wait for the process to end, or end it if it grows too large or hangs. Return why it ended."""
        why, last_words, open_pipes = "", "", [self._connection]
        silent_looks, max_silent = 0, _MAX_START_LOOKS
        while self._process.sentinel not in (ready := wait([self._process.sentinel, *open_pipes], LOOK_S)):
            if not ready:  # counted, not timed: this process may have been stopped for a while itself
                silent_looks += 1
            else:
                silent_looks, max_silent = 0, MAX_SILENT_LOOKS
                if (text := self._hear()) is None:
                    open_pipes = []
                else:
                    last_words = text
            if not why and (why := _fault(self._process.pid, silent_looks, max_silent)):
                self._is_alive = False
                self._process.kill()
        self._is_alive = False
        self._process.join()
        while (text := self._hear()) is not None:
            last_words = text
        self._connection.close()
        return why or last_words or f"exit code {self._process.exitcode}"

    def _hear(self) -> str | None:
        """Return the last words of the process, "" if it said something else; None where it can send no
        more."""
        try:
            data = self._connection.recv_bytes(_MAX_MESSAGE_BYTES)
        except (EOFError, OSError):
            return None
        if data.startswith(REPORT):
            self._on_report(data)
            return ""
        return data[: 4 * MAX_LAST_WORDS].decode(errors="replace")


class ServedPage:
    """A page that a process of its own serves: its listening socket, the feed to the process, and that.
    `close` may be repeated."""

    def __init__(self, listener: socket.socket, feed: ViewFeed, process: PageProcess) -> None:
        self._listener, self.feed, self._process = listener, feed, process

    @property
    def pid(self) -> int | None:
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """Whether there is a process that serves the page, or will in a moment."""
        return self._process.is_alive

    def close(self) -> None:
        """End the process."""
        self._process.announce_end()
        self.feed.close()
        self._process.close()
        self._listener.close()


def begin_process(niceness: int, listener: socket.socket) -> None:
    """Set up a page's process, to be called first in it."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # systemd sends it to all; the parent ends this process
    os.nice(niceness)
    _silence_output()
    listener.setblocking(False)


def end_process(
    connection: Connection, run: Callable[[], None], parent_ended: tuple[type[Exception], ...]
) -> None:
    """Run a page's process to its end, and exit; say what ends it. parent_ended: what `run` raises where its
    parent has ended."""
    code = 1
    try:
        run()
        code = 0
    except parent_ended:
        code = 0
    except Exception as error:
        with contextlib.suppress(OSError):
            connection.send_bytes(_last_words(error))
    finally:
        os._exit(code)  # threads of libraries would keep the process


def _fault(pid: int | None, silent_looks: int, max_silent: int) -> str:
    """Return why a process has to be ended, "" if it need not be."""
    if _memory_bytes(pid) > MAX_BYTES:
        return f"it took more than {MAX_BYTES / 2**20:.0f} MB of memory"
    return f"it did not answer for {silent_looks * LOOK_S:.0f} s" if silent_looks >= max_silent else ""


def _memory_bytes(pid: int | None) -> int:
    """Return the memory that a process holds; 0 where the system does not say."""
    try:
        return 0 if pid is None else tcp.resident_bytes(pid)
    except (OSError, IndexError, ValueError):
        return 0


def _last_words(error: Exception) -> bytes:
    """Return what a process says, as its last message, of what ends it."""
    text = " ".join(f"{type(error).__name__}: {error}".split())[:MAX_LAST_WORDS]
    return text.removeprefix(REPORT.decode()).encode()


def _silence_output() -> None:
    """Discard what libraries print: a page's process says nothing on its parent's terminal."""
    null = os.open(os.devnull, os.O_WRONLY)
    sys.stdout.flush()
    for stream in (1, 2):
        os.dup2(null, stream)
    os.close(null)
