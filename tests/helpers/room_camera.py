"""A recording of a room, played through the SDK's camera of software."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from helpers.software_camera import DEPTH_UNIT_M, SoftwareCamera

from share.cameras.feed import CameraFeed, MakeWatchdog
from share.cameras.realsense.camera import RealSenseCamera
from share.cameras.realsense.streams import StreamRequest
from share.cameras.sample_queue import SampleQueue
from share.errors import UsageError
from share.runtime.source import Source
from share.sensors.profile import load_profile
from share.sensors.watchdog import Watchdog

HZ, LENS = 15, (385.0, 385.0, 320.4, 239.6)  # of the demo's cameras
STEREO = StreamRequest(load_profile("d435i", f"640x480@{HZ}"))
RGBD = StreamRequest(STEREO.profile, depth=True, right=False)
BEGIN_US = 5_000_000  # of the camera's clock


class RoomCamera:
    """The devices of `source`, with its lenses. It plays when somebody listens."""

    def __init__(self, rs: Any, source: Source, serial: str = "0123") -> None:
        self.source, self.camera = source, SoftwareCamera(rs, serial, rate_hz=HZ, lens=LENS, depth=True)
        self.there = True  # it can be connected
        self.first_ns = next(iter(source.measurements())).stamp_ns

    def device(self, wanted: StreamRequest, epoch: int = 0) -> RealSenseCamera:
        return RealSenseCamera(wanted, context=self.camera.context, epoch=epoch)

    def feed(
        self, wanted: StreamRequest, queue: SampleQueue, said: list[str], watchdog: MakeWatchdog = Watchdog
    ) -> CameraFeed:
        """What the camera delivers, not opened yet."""

        def connect(serial: str | None, epoch: int) -> RealSenseCamera:
            if not self.there:
                raise UsageError("no camera")
            return self.device(wanted, epoch)

        return CameraFeed(connect, None, wanted.rates_hz(), said.append, queue, watchdog)

    def play(self, before_image: Callable[[], None] = lambda: None, begin_us: int = BEGIN_US) -> int:
        """All of it; the stamp of the camera's clock after it. before_image: called before each frame."""
        now = begin_us
        for m in self.source.measurements():
            now = begin_us + (m.stamp_ns - self.first_ns) // 1000
            if m.stream == "imu":
                self.camera.force(now, *m.payload[3:])
                self.camera.turn(now, *m.payload[:3])
            elif m.stream == "depth":
                steps = np.nan_to_num(m.payload.load()) / DEPTH_UNIT_M
                self.camera.far(now, np.rint(steps).astype(np.uint16))
            else:
                if m.stream == "cam0":
                    before_image()
                self.camera.image(m.stream == "cam1", now, m.payload.load())
        return now

    def taken(self, feed: CameraFeed, pause_s: float = 0.0) -> Callable[[], None]:
        """Waits until all frames that were shown before have been taken; where a pause is given, so long."""
        images = [name for name in feed.processor.streams if name not in ("accel", "gyro")]
        shown = itertools.count()

        def wait() -> None:
            before, until = next(shown), time.monotonic() + 20
            time.sleep(pause_s)
            while not pause_s and time.monotonic() < until:
                if all(feed.processor.streams[name].samples >= before for name in images):
                    return
                time.sleep(0.001)

        return wait

    def begin(self, feed: CameraFeed, pause_s: float = 0.0) -> threading.Thread:
        """Play to who reads `feed`, then stop it. See `taken`."""

        def play() -> None:
            time.sleep(0.2)  # until the sensors deliver
            self.play(self.taken(feed, pause_s))
            time.sleep(0.5)
            feed.stop()

        thread = threading.Thread(target=play, daemon=True)
        thread.start()
        return thread
