"""A process that captures from a camera of software until it is ended. Argument: the recording."""

from __future__ import annotations

import sys
import threading

import numpy as np
import pyrealsense2 as rs
from software_camera import SoftwareCamera
from software_share import share

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


share(
    ["capture", "--profile", "d435i", "--min-free-gb", "0", "--out", sys.argv[1], *sys.argv[2:]], CAMERA, play
)
