"""A process that captures from a camera of software until it is ended. Argument: the recording."""

from __future__ import annotations

import sys
import threading
import time

import numpy as np
import pyrealsense2 as rs
from software_camera import SoftwareCamera

from share.cli import main as command_line
from share.io.realsense import camera as adapter


def feed(camera: SoftwareCamera) -> None:
    picture = np.random.default_rng(1).integers(0, 255, (480, 640), np.uint8)
    for k in range(10_000):
        now = 1_000_000 + k * 33_333
        for i in range(13):
            camera.force(now + i * 2500, 0.0, 0.0, 9.8)
            camera.turn(now + i * 2500, 0.0, 0.0, 0.0)
        for eye in (0, 1):
            camera.image(eye, now, picture)
        time.sleep(0.033)


CAMERA = SoftwareCamera(rs)
rs.context = lambda: CAMERA.context
START = adapter.RealSense.start


def start(self: adapter.RealSense, sink: adapter.Sink) -> None:
    START(self, sink)
    threading.Thread(target=feed, args=(CAMERA,), daemon=True).start()


adapter.RealSense.start = start  # type: ignore[method-assign]
command_line.main(
    ["capture", "--profile", "d435i", "--min-free-gb", "0", "--out", sys.argv[1], *sys.argv[2:]]
)
