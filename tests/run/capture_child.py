"""A process that captures from a camera of software until it is ended. Argument: the recording.
CHILD_SLOW_DISK_S in its environment: what an image of cam0 costs the disk."""

from __future__ import annotations

import os
import sys
import threading
import time

import numpy as np
import pyrealsense2 as rs
from helpers.software_camera import SoftwareCamera
from helpers.software_share import share

from share.recordings.mcap.recorder import Recorder
from share.sensors.measurement import Measurement

CAMERA = SoftwareCamera(rs)


def play(ended: threading.Event) -> None:
    picture = np.random.default_rng(1).integers(0, 255, (480, 640), np.uint8)
    for k in range(10_000):
        now = 1_000_000 + k * 33_333
        for i in range(13):
            CAMERA.force(now + i * 2500, 0.0, 0.0, 9.8)
            CAMERA.turn(now + i * 2500, 0.0, 0.0, 0.0)
        for eye in (0, 1):
            CAMERA.image(eye, now, picture)
        if ended.wait(0.033):
            return


if pause_s := float(os.environ.get("CHILD_SLOW_DISK_S", 0)):
    write = Recorder.write

    def slow(self: Recorder, measurement: Measurement, log_ns: int | None = None) -> None:
        time.sleep(pause_s if measurement.stream == "cam0" else 0)
        write(self, measurement, log_ns)

    Recorder.write = slow  # type: ignore[method-assign]

share(
    ["capture", "--profile", "d435i", "--min-free-gb", "0", "--out", sys.argv[1], *sys.argv[2:]], CAMERA, play
)
