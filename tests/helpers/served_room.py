"""The edge's own headset server before a browser: with an edge's protocol on a real link, and wearers whose
devices' poses come to it. Only the mapper and the agents are left out."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from helpers import emulated_wearer as worn
from helpers.browser import Browser, BrowserPage
from helpers.headset_client import code
from helpers.room_server import MAP, RoomServer

from share.headset.headset_page import HeadsetPage
from share.headset.wearers import EdgeAccess
from share.mapping.map_changes import SaveObject
from share.types import AgentKind, TrackState
from share.view import events as ev
from share.wire.room_messages import Permission

AGE_S = 0.012  # of a pose when it comes to the edge


@dataclass
class ServedRoom:
    """walk: of all wearers. states: of their devices, by name; OK where there is none. clock_error_s: of the
    devices."""

    edge: RoomServer
    page: HeadsetPage
    walk: worn.Walk = field(default_factory=worn.Walk)
    states: dict[str, TrackState] = field(default_factory=dict)
    clock_error_s: float = 0.0
    _used_code: str = ""
    _kept: list[SaveObject] = field(default_factory=list)

    def next_code(self) -> str:
        """The code for the next wearer."""
        self._used_code = code(self.page, self._used_code)
        return self._used_code

    def end_edge(self) -> None:
        self._kept = self.edge.edge.room.kept_objects()
        self.edge.__exit__()

    def begin_edge(self) -> None:
        """Begin another edge at the address of the one that ended, with the objects of its map's file."""
        self.edge = RoomServer(address=self.edge.address, session=8, objects=self._kept).__enter__()

    @property
    def url(self) -> str:
        return f"http://{self.page.endpoint}/"


@contextmanager
def served_room(folder: Path, names: Sequence[str] = ("ann", "ben")) -> Iterator[ServedRoom]:
    """Serve the page to wearers of these names. folder: temporary, as XDG_CONFIG_HOME has to be."""
    rows = [f"  - [{', '.join(f'{value:.12g}' for value in row)}]" for row in worn.T_body_viewer]
    mount = folder / "headset.yaml"
    mount.write_text("\n".join(["T_body_viewer:", *rows, ""]))
    mounts = [f"{name}={mount}" for name in names]
    edge = RoomServer().__enter__()
    access = EdgeAccess(edge.address, frozenset(Permission))
    with closing(HeadsetPage("http://127.0.0.1:0", access, mounts=mounts)) as page:
        room = ServedRoom(edge, page)
        room.walk.walks = True
        try:
            with _moving(room, names):
                yield room
        finally:
            room.edge.__exit__()


@contextmanager
def _moving(room: ServedRoom, names: Sequence[str]) -> Iterator[None]:
    """Poses of devices on heads, thirty times a second."""
    feed, ended = room.page.feed, threading.Event()
    for name in names:
        feed.add_event(ev.RunArrived(f"{name}-1", name, AgentKind.AR, np.eye(4), (0.8, 0.6)))
        feed.add_event(ev.CorrectionArrived(f"{name}-1", MAP, np.eye(4), 0))

    to_wall_s = time.time() - time.monotonic()

    def move() -> None:
        while not ended.wait(1 / 30):
            now_ns = time.monotonic_ns()  # alone says where the device is: a busy machine may stop here
            T, _, _ = room.walk(to_wall_s + 1e-9 * now_ns - AGE_S)
            stamp_ns = now_ns + round((room.clock_error_s - AGE_S) * 1e9)
            for name in names:
                state = room.states.get(name, TrackState.OK)
                times = 1e3 * AGE_S, stamp_ns, now_ns, 0.006, 0.002
                feed.add_event(ev.PoseArrived(f"{name}-1", state, -1, T, *times))

    thread = threading.Thread(target=move)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def wear(chromium: Browser, room: ServedRoom, name: str, url: str = "") -> BrowserPage:
    """Wear a headset as `name` and walk about until what is drawn stays in its place. url: another way to the
    page."""
    page = worn.wear(chromium, url or room.url, name, room.next_code())
    worn.walk_aligned(page)
    return page
