"""A capture from a camera of software in a thread of its own, and the camera that feeds it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
from helpers.software_camera import SoftwareCamera

from share.cameras.feed import CameraFeed, MakeWatchdog
from share.cameras.realsense.camera import RealSenseCamera
from share.cameras.realsense.devices import load_sdk
from share.cameras.realsense.streams import StreamRequest
from share.cameras.sample_queue import SampleQueue
from share.errors import ShareError, UsageError
from share.recordings.calibration import Calibration
from share.runtime.capture import Capture
from share.sensors.profile import load_profile
from share.sensors.watchdog import Watchdog

WANTED = StreamRequest(load_profile("d435i"))
PICTURE = np.tile(np.arange(640, dtype=np.uint16) % 251, (480, 1)).astype(np.uint8)
WRAP_US = 2**32


class Fake:
    """RealSense on a camera of software, whose hardware reset is counted instead of done."""

    resets = 0

    def __init__(
        self, camera: SoftwareCamera, wanted: StreamRequest, epoch: int, say: Callable[[str], None]
    ) -> None:
        self.device = RealSenseCamera(wanted, context=camera.context, epoch=epoch, notify=say)
        self.rig, self.serial, self.rates_hz = self.device.rig, self.device.serial, self.device.rates_hz
        self.start, self.stop = self.device.start, self.device.stop

    def reset(self) -> None:
        Fake.resets += 1
        self.stop()


class Bench:
    """A capture in a thread of its own, and the camera that feeds it."""

    def __init__(
        self,
        out: Path,
        watchdog: MakeWatchdog = Watchdog,
        wanted: StreamRequest = WANTED,
        most_images: int = 60,
        calibration: Calibration | None = None,
    ) -> None:
        self.camera = SoftwareCamera(load_sdk(), depth=wanted.depth)
        self.said, self.there, self.error = list[str](), True, ""
        self.wanted, self.connected = wanted, 0
        queue = SampleQueue(most_images)
        self.source = CameraFeed(self.connect, None, wanted.rates_hz(), self.said.append, queue, watchdog)
        self.run = Capture(self.source, out, 0.0, self.said.append, calibration=calibration)
        self.report: dict[str, Any] = {}
        self.thread = threading.Thread(target=self._go, daemon=True)

    def connect(self, serial: str | None, epoch: int) -> Fake:
        if not self.there:
            raise UsageError("no camera")
        fake = Fake(self.camera, self.wanted, epoch, self.said.append)
        self.connected += 1
        return fake

    def __enter__(self) -> Bench:
        Fake.resets = 0
        self.thread.start()
        self.wait(lambda: self.connected > 0)
        time.sleep(0.3)  # until the sensors deliver
        return self

    def __exit__(self, *error: object) -> None:
        time.sleep(0.3)  # until all has been read
        self.run.stop()
        self.thread.join(timeout=10)
        assert not self.thread.is_alive()

    def wait(self, until: Callable[[], bool], limit_s: float = 8.0) -> None:
        end = time.monotonic() + limit_s
        while not until():
            assert time.monotonic() < end, f"waited in vain; said: {self.said}"
            time.sleep(0.02)

    def feed(
        self,
        begin_us: int,
        frames: int,
        imu: bool = True,
        wrap: bool = False,
        host_us: int | None = None,
        eyes: tuple[int, ...] = (0, 1),
    ) -> int:
        """Frames at 30 Hz with IMU at 400 and 250 Hz; gives the stamp after them. host_us: where the host's
        clock begins, by which images are stamped then."""
        for k in range(frames):
            now = begin_us + k * 33_333
            at = [(now + i * 2500, True) for i in range(13)] + [(now + i * 4000, False) for i in range(8)]
            for stamp, turns in sorted(at) if imu else []:
                device_us = stamp % WRAP_US if wrap else stamp
                (self.camera.turn if turns else self.camera.force)(device_us, 0.1, 0.2, 9.8)
            for eye in eyes:
                if host_us is not None:
                    host = self.camera.rs.timestamp_domain.system_time
                    self.camera.image(eye, host_us + now - begin_us, PICTURE, host)
                else:
                    self.camera.image(eye, now % WRAP_US if wrap else now, PICTURE)
            time.sleep(0.01 if host_us is None else 0.033)
        return begin_us + frames * 33_333

    def _go(self) -> None:
        try:
            self.report = self.run.run()
        except ShareError as error:
            self.error = str(error)


def quick(now_ns: int, streams: Collection[str]) -> Watchdog:
    return Watchdog(now_ns, streams, silent_ms=600, warm_up_ms=800, retry_ms=100, reset_ms=100)
