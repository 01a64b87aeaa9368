"""`share` in a process whose only camera is one of software. Arguments: SESSION/NAME that it sees, again and
again, at its own pace; then those of `share`."""

from __future__ import annotations

import sys
import threading

import pyrealsense2 as rs
from helpers.room_camera import BEGIN_US, RoomCamera
from helpers.software_share import share

from share.runtime.source import open_source

ROOM = RoomCamera(rs, open_source(sys.argv[1]))


def play(ended: threading.Event) -> None:
    def pause() -> None:
        """Before each frame."""
        if ended.wait(1 / 15):
            sys.exit()  # of the thread that plays

    now = BEGIN_US
    while True:
        now = 100_000 + ROOM.play(pause, now)


share(sys.argv[2:], ROOM.camera, play)
