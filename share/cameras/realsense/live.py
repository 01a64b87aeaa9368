"""realsense[:SERIAL] to a feed of its samples, and to a SOURCE."""

from __future__ import annotations

from collections.abc import Callable

from share.cameras.feed import Feed
from share.cameras.handover import Handover, KeepNewest
from share.cameras.live import WAITING, LiveSource
from share.cameras.realsense.camera import RealSense
from share.cameras.realsense.devices import serial_of
from share.cameras.realsense.streams import Wanted
from share.config import SequencerConfig
from share.recordings.calibration import Calibration
from share.sensors.measurement import CAM0


def feed_of(
    spec: str, wanted: Wanted, config: SequencerConfig, say: Callable[[str], None], queue: Handover
) -> Feed:
    """What the camera delivers. It is not opened yet."""
    return Feed(
        lambda serial, epoch: RealSense(wanted, serial, epoch=epoch, say=say),
        serial_of(spec),
        wanted.rates_hz(),
        config.max_jump_s,
        say,
        queue,
    )


def open_live(
    spec: str,
    wanted: Wanted,
    config: SequencerConfig,
    say: Callable[[str], None],
    calibration: Calibration | None = None,
) -> LiveSource:
    """The camera as a source, with the factory's calibration or another.

    Raises UsageError, ShareError, DataError.
    """
    rates = wanted.rates_hz()
    queue = KeepNewest(WAITING * len(wanted.cameras))
    feed = feed_of(spec, wanted, config, say, queue)
    return LiveSource(feed, rates[CAM0], calibration, wanted.imu_range())
