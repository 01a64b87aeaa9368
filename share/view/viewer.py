"""The live room's process: takes events, and draws what has changed, at most fifteen times a second, while
some browser looks. It has the lowest priority.
"""

from __future__ import annotations

import pickle
import socket
import time
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from multiprocessing.connection import Connection
from typing import Any

from share.agent_names import natural_order
from share.errors import ShareError, UsageError
from share.net.http_guard import HttpGuard, http_address, listen
from share.net.transport import Address
from share.timing import PeriodicTimer
from share.view.events import KeyframeArrived, SessionBegun
from share.view.feed import END, ViewFeed
from share.view.page_process import HEARTBEAT, LOOK_S, PageProcess, ServedPage, begin_process, end_process

DRAW_HZ = 15.0
_KEYFRAMES_PER_NOTE = 200  # of a map file, between updates of how much is read
_PANEL_S = 0.5  # between updates of the panel
_NICENESS = 15
_MAX_MESSAGES = 64  # applied before something is drawn
MISSING = "the live room needs viser: pip install 'viser>=1.1,<1.2'"


def is_installed() -> bool:
    return find_spec("viser") is not None


class LiveRoom(ServedPage):
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
        listener, bound = listen(http_address("--view", address, token))
        self.endpoint = str(bound).removeprefix("tcp://")
        feed = ViewFeed()
        arguments = (listener, bound, token, title)
        process = PageProcess("live room", _run, arguments, notify, feed.reconnect)
        super().__init__(listener, feed, process)


def _run(
    connection: Connection, listener: socket.socket, bound: Address, token: str | None, title: str
) -> None:
    """Entry point of the process."""
    begin_process(_NICENESS, listener)
    from share.view.window import Window

    viewer = Viewer(connection, Window(listener, HttpGuard(bound, token), title))
    end_process(connection, viewer.run, (EOFError, OSError))


class Viewer:
    """Applies events to a room and draws it."""

    def __init__(self, connection: Connection, window: Any) -> None:
        from share.view.panel import SidePanel
        from share.view.room import DrawnRoom

        self._connection, self._window = connection, window
        self._room, self._panel = DrawnRoom(), SidePanel()
        self._panel_due_s = 0.0
        self._heartbeat = PeriodicTimer(LOOK_S)
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
            self._connection.send_bytes(HEARTBEAT)

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
            followed = sorted(agents.values(), key=natural_order)
            self._window.show_panel(self._panel.html(self._room, now_s), followed)

    def _place(self, agents: Mapping[str, str], name: str) -> Any:
        run = next((run for run, label in agents.items() if label == name), None)
        return None if run is None else self._room.agent_place(run)
