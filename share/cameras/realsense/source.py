"""Open the SOURCE realsense[:SERIAL], as a feed of samples or as a live source."""

from __future__ import annotations

from collections.abc import Callable

from share.cameras.feed import CameraFeed
from share.cameras.live import MAX_WAITING_FRAMES, LiveSource
from share.cameras.realsense.camera import RealSenseCamera
from share.cameras.realsense.devices import parse_serial
from share.cameras.realsense.streams import StreamRequest
from share.cameras.sample_queue import NewestImageQueue, SampleQueue
from share.recordings.calibration import Calibration
from share.sensors.measurement import CAM0


def make_feed(
    spec: str,
    request: StreamRequest,
    notify: Callable[[str], None],
    queue: SampleQueue,
) -> CameraFeed:
    """Return the camera's feed, not yet opened."""
    return CameraFeed(
        lambda serial, epoch: RealSenseCamera(request, serial, epoch=epoch, notify=notify),
        parse_serial(spec),
        request.rates_hz(),
        notify,
        queue,
    )


def open_live(
    spec: str,
    request: StreamRequest,
    notify: Callable[[str], None],
    calibration: Calibration | None = None,
) -> LiveSource:
    """Open the camera as a source, with `calibration` or else the factory's.

    Raises UsageError, ShareError, DataError.
    """
    rates = request.rates_hz()
    queue = NewestImageQueue(MAX_WAITING_FRAMES * len(request.cameras))
    feed = make_feed(spec, request, notify, queue)
    return LiveSource(feed, rates[CAM0], calibration, request.imu_range())
