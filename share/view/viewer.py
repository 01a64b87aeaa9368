"""The live room's process: takes events, and draws what has changed, at most fifteen times a second, while
some browser looks.

It has the lowest priority and ends with the process that started it, which it can neither hold up nor end.
That one starts it again if it ends by itself, and ends it if its heartbeat stops.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from multiprocessing.connection import Connection, wait
from typing import Any

from share.errors import ShareError, UsageError
from share.net import tcp
from share.net.http_guard import HttpGuard, http_address, listen
from share.net.transport import Address
from share.spawning import SPAWN_CONTEXT
from share.timing import Backoff, PeriodicTimer
from share.view.events import KeyframeArrived, SessionBegun
from share.view.feed import END, ViewFeed

DRAW_HZ = 15.0
_KEYFRAMES_PER_NOTE = 200  # of a map file, between updates of how much is read
_PANEL_S = 0.5  # between updates of the panel
_NICENESS = 15
_STOP_S = 2.0
_MAX_MESSAGES = 64  # applied before something is drawn
_MAX_REASON = 200  # characters
_LOOK_S = 1.0  # between looks at the process, and between its heartbeats
_HEARTBEAT = b""
MAX_SILENT_LOOKS = 30  # in a row without a heartbeat: it hangs
_MAX_START_LOOKS = 120  # before the first one: it has the lowest priority
MAX_BYTES = 2**30  # of its memory
_HEALTHY_NS = 60_000_000_000  # a live room that ran for so long waits 1 s again before its next start
MISSING = "the live room needs viser: pip install 'viser>=1.1,<1.2'"


def is_installed() -> bool:
    return find_spec("viser") is not None


class LiveRoom:
    """A viewer's process, and the feed to it. One that ends by itself is started again. `close` may be
    repeated.

    address: HOST:PORT, or a PORT of this machine. token: as in `http_guard`; None: none is needed. notify: is
    called with a line, from another thread, if the process ends by itself or hangs.
    Raises UsageError where viser is missing or the address is malformed, TransportError if it cannot be
    bound.
    """

    def __init__(
        self, address: str, token: str | None, title: str, notify: Callable[[str], None] = lambda text: None
    ) -> None:
        if not is_installed():
            raise UsageError(f"--view: {MISSING}")
        self._listener, self._bound = listen(http_address("--view", address, token))
        self.endpoint = str(self._bound).removeprefix("tcp://")
        self._token, self._title, self._notify = token, title, notify
        self._closing = threading.Event()
        self._start()
        self.feed = ViewFeed(self._connection)
        self._watcher = threading.Thread(target=self._watch, name="view-watch", daemon=True)
        self._watcher.start()

    @property
    def pid(self) -> int | None:
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """Whether there is a process that serves the page, or will in a moment."""
        return self._is_alive

    def close(self) -> None:
        """End the process."""
        self._closing.set()
        self.feed.close()
        self._watcher.join(_STOP_S)
        if self._watcher.is_alive():
            self._process.kill()
            self._watcher.join()
        self._listener.close()

    def _start(self) -> None:
        """Raises OSError if the system is out of processes, memory or file descriptors."""
        self._connection, child_end = SPAWN_CONTEXT.Pipe()
        self._process = SPAWN_CONTEXT.Process(
            target=_run,
            args=(child_end, self._listener, self._bound, self._token, self._title),
            name="view",
            daemon=True,
        )
        self._process.start()
        child_end.close()
        self._is_alive = True

    # ------------------------------------------------------------------ the watching thread

    def _watch(self) -> None:
        backoff = Backoff(time.monotonic_ns(), _HEALTHY_NS)
        while True:
            why = self._wait_for_end()
            if self._closing.is_set():
                return
            delay_s = backoff.record_failure(time.monotonic_ns())
            self._notify(f"the live room has ended ({why}) and starts again in {delay_s:.0f} s")
            if self._closing.wait(delay_s):
                return
            try:
                self._start()
            except OSError as error:
                self._notify(
                    f"the live room cannot start again: {error.strerror}; the edge goes on without it"
                )
                return
            self.feed.reconnect(self._connection)

    def _wait_for_end(self) -> str:
        """Wait for the process to end, or end it if it grows too large or hangs. Return why it ended."""
        why, last_words, open_pipes = "", "", [self._connection]
        silent_looks, max_silent = 0, _MAX_START_LOOKS
        while self._process.sentinel not in (ready := wait([self._process.sentinel, *open_pipes], _LOOK_S)):
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
        """Return the next message of the process, "" if it is a heartbeat; None where it can send no more."""
        try:
            return self._connection.recv_bytes(4 * _MAX_REASON).decode(errors="replace")
        except (EOFError, OSError):
            return None


def _fault(pid: int | None, silent_looks: int, max_silent: int) -> str:
    """Return why a process has to be ended, "" if it need not be."""
    if _memory_bytes(pid) > MAX_BYTES:
        return f"it took more than {MAX_BYTES / 2**20:.0f} MB of memory"
    return f"it did not answer for {silent_looks * _LOOK_S:.0f} s" if silent_looks >= max_silent else ""


def _memory_bytes(pid: int | None) -> int:
    """Return the memory that a process holds; 0 where the system does not say."""
    try:
        return 0 if pid is None else tcp.resident_bytes(pid)
    except (OSError, IndexError, ValueError):
        return 0


def _run(
    connection: Connection, listener: socket.socket, bound: Address, token: str | None, title: str
) -> None:
    """Entry point of the process."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # systemd sends it to all; the parent ends this process
    os.nice(_NICENESS)
    _silence_output()
    from share.view.window import Window

    listener.setblocking(False)
    window = Window(listener, HttpGuard(bound, token), title)
    code = 1
    try:
        Viewer(connection, window).run()
        code = 0
    except (EOFError, OSError):  # the parent has ended
        code = 0
    except Exception as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())
        with contextlib.suppress(OSError):
            connection.send_bytes(text[:_MAX_REASON].encode())
    finally:
        os._exit(code)  # threads of viser would keep the process


def _silence_output() -> None:
    """Discard what libraries print: this process says nothing on its parent's terminal."""
    null = os.open(os.devnull, os.O_WRONLY)
    sys.stdout.flush()
    for stream in (1, 2):
        os.dup2(null, stream)
    os.close(null)


class Viewer:
    """Applies events to a room and draws it."""

    def __init__(self, connection: Connection, window: Any) -> None:
        from share.view.panel import SidePanel
        from share.view.room import DrawnRoom

        self._connection, self._window = connection, window
        self._room, self._panel = DrawnRoom(), SidePanel()
        self._panel_due_s = 0.0
        self._heartbeat = PeriodicTimer(_LOOK_S)
        self._is_ended = False

    def run(self) -> None:
        """Draw until the feed ends. Raises EOFError or OSError if the other process has died."""
        while not self._is_ended:
            start_s = time.monotonic()
            self._take_events(start_s)
            self._draw(time.monotonic())
            self._show_that_it_runs()
            time.sleep(max(0.005, 1 / DRAW_HZ - (time.monotonic() - start_s)))

    def _show_that_it_runs(self) -> None:
        if self._heartbeat.fire_if_due(time.monotonic_ns()) and self._window.has_served():
            self._connection.send_bytes(_HEARTBEAT)

    def _take_events(self, now_s: float) -> None:
        for _ in range(_MAX_MESSAGES):
            if not self._connection.poll():
                return
            data = self._connection.recv_bytes()
            if data == END:
                self._is_ended = True
                return
            for event in pickle.loads(data):  # of our own parent process
                self._apply(event, now_s)
                if isinstance(event, SessionBegun) and event.map_file is not None:
                    self._load(event, now_s)

    def _load(self, event: SessionBegun, now_s: float) -> None:
        from share.view.sources import map_file_events

        assert event.map_file is not None
        self._show_loading("loading the map", now_s)
        try:
            count = 0
            for stored in map_file_events(event.map_file):
                self._apply(stored, now_s)
                self._show_that_it_runs()
                count += isinstance(stored, KeyframeArrived)
                if count % _KEYFRAMES_PER_NOTE == 1:
                    self._show_loading(f"loading the map: {count} keyframes so far", now_s)
        except ShareError:
            pass  # the edge reports its own problems
        self._show_loading("", now_s)

    def _show_loading(self, text: str, now_s: float) -> None:
        """Show it at once, and to browsers that come meanwhile: nothing is drawn until all is read."""
        self._panel.loading = text
        self._window.show_panel(self._panel.html(self._room, now_s), ())

    def _apply(self, event: Any, now_s: float) -> None:
        self._panel.apply(event)
        self._room.apply(event, now_s)

    def _draw(self, now_s: float) -> None:
        """Draw what has changed. While nobody looks it is only remembered: drawing costs the most."""
        if not self._window.is_watched():
            self._room.forget_moments(now_s)
            return
        if drawings := self._room.take_drawings(now_s):
            self._window.draw(drawings)
        for click in self._window.take_clicks():
            with self._window.disconnect_on_failure(click.browser):
                if (views := self._room.loop_at(click.origin, click.direction)) is not None:
                    self._window.show_views(click.browser, views)
        agents = self._panel.agents
        self._window.follow(lambda name: self._place(agents, name))
        if now_s >= self._panel_due_s:
            self._panel_due_s = now_s + _PANEL_S
            self._window.show_panel(self._panel.html(self._room, now_s), sorted(agents.values()))

    def _place(self, agents: Mapping[str, str], name: str) -> Any:
        run = next((run for run, label in agents.items() if label == name), None)
        return None if run is None else self._room.agent_place(run)
