"""A program's own camera as an agent's live camera: samples are pushed, and the newest images are tracked."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from numpy.typing import ArrayLike, NDArray

from share.cameras.feed import CameraFeed
from share.cameras.live import MAX_WAITING_FRAMES, LiveSource
from share.cameras.sample_queue import NewestImageQueue
from share.errors import UsageError
from share.geometry.camera import Rig
from share.library.checked_input import image_samples, imu_sample
from share.sensors.measurement import CAM0
from share.sensors.sample_processor import ACCEL, GYRO, DeviceSample


class OwnCamera:
    """A `share.cameras.feed.CameraDevice` whose samples a program pushes, from any one thread."""

    def __init__(self, rig: Rig, rate_hz: float) -> None:
        """rate_hz: of cam0's images."""
        self.rig, self.serial = rig, "own camera"
        rates = dict.fromkeys(rig.cameras, rate_hz)
        self.rates_hz: Mapping[str, float] = (
            rates if rig.imu is None else rates | dict.fromkeys((ACCEL, GYRO), rig.imu.rate_hz)
        )
        self._sink: Callable[[DeviceSample], None] | None = None

    def start(self, sink: Callable[[DeviceSample], None]) -> None:
        self._sink = sink

    def stop(self) -> None:
        self._sink = None

    def reset(self) -> None:
        """The program that pushes samples has nothing to reset."""

    def feed_imu(self, stamp_ns: int, gyro: ArrayLike, accel: ArrayLike) -> None:
        """As `Tracker.feed_imu`. Raises UsageError."""
        if self.rig.imu is None:
            raise UsageError("gyro: the rig has no IMU; load a calibration with Kalibr's IMU chain")
        sample = imu_sample(stamp_ns, gyro, accel)
        for stream, values in ((ACCEL, sample.payload[3:]), (GYRO, sample.payload[:3])):
            self._push(stream, sample.stamp_ns, values)

    def feed_images(
        self,
        stamp_ns: int,
        image0: NDArray[Any],
        image1: NDArray[Any] | None = None,
        depth: NDArray[Any] | None = None,
    ) -> None:
        """As `Tracker.feed_images`. Raises UsageError."""
        for sample in image_samples(self.rig, stamp_ns, image0, image1, depth):
            self._push(sample.stream, sample.stamp_ns, sample.payload)

    def _push(self, stream: str, stamp_ns: int, payload: Any) -> None:
        if (sink := self._sink) is not None:  # else nobody listens: before the start, after the end
            sink(DeviceSample(stream, stamp_ns, payload, time.monotonic_ns()))


class OwnCameraSource(LiveSource):
    """An `OwnCamera` as a SOURCE."""

    def __init__(self, camera: OwnCamera, notify: Callable[[str], None]) -> None:
        queue = NewestImageQueue(MAX_WAITING_FRAMES * len(camera.rig.cameras))
        feed = CameraFeed(lambda serial, attempts: camera, None, camera.rates_hz, notify, queue)
        super().__init__(feed, camera.rates_hz[CAM0])
        self.name, self.serial = camera.serial, None
