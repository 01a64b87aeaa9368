"""`share` in this process, with a camera of software as the only one there is."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import pyrealsense2 as rs
from helpers.software_camera import SoftwareCamera

from share.cameras.realsense import camera as adapter
from share.cli import main as command_line


def share(words: Sequence[str], camera: SoftwareCamera, play: Callable[[threading.Event], None]) -> None:
    """`share WORDS`. play feeds the camera, in a thread of its own from the moment at which its sensors are
    started, until the event that it is given is set."""
    started, ended, threads = adapter.RealSenseCamera.start, threading.Event(), []

    def start(self: adapter.RealSenseCamera, sink: adapter.Sink) -> None:
        started(self, sink)
        threads.append(threading.Thread(target=play, args=(ended,), daemon=True))
        threads[-1].start()

    rs.context = lambda: camera.context
    adapter.RealSenseCamera.start = start  # type: ignore[method-assign]
    try:
        command_line.main(list(words))
    finally:  # before the SDK is taken down under who still feeds it
        ended.set()
        for thread in threads:
            thread.join()
