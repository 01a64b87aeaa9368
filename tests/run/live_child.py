"""`share` in a process whose only camera is one of software. Arguments: SESSION/NAME that it sees, again and
again, at its own pace; then those of `share`."""

from __future__ import annotations

import sys
import threading

import pyrealsense2 as rs
from room_camera import BEGIN_US, RoomCamera

from share.cli import main as command_line
from share.io.realsense import camera as adapter
from share.io.source import open_source

ROOM = RoomCamera(rs, open_source(sys.argv[1]))
rs.context = lambda: ROOM.camera.context
START = adapter.RealSense.start


ENDED = threading.Event()
THREADS: list[threading.Thread] = []


def pause() -> None:
    """Before each frame."""
    if ENDED.wait(1 / 15):
        sys.exit()  # of the thread that plays


def play() -> None:
    now = BEGIN_US
    while True:
        now = 100_000 + ROOM.play(pause, now)


def start(self: adapter.RealSense, sink: adapter.Sink) -> None:
    START(self, sink)
    THREADS.append(threading.Thread(target=play, daemon=True))
    THREADS[-1].start()


adapter.RealSense.start = start  # type: ignore[method-assign]
try:
    command_line.main(sys.argv[2:])
finally:  # before the SDK is taken down under who still feeds it
    ENDED.set()
    for thread in THREADS:
        thread.join()
