"""A live camera as a SOURCE: frames as they come, until stopped."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from share.cameras.feed import CameraFeed
from share.errors import UsageError
from share.geometry.camera import Rig
from share.recordings.calibration import Calibration
from share.recordings.calibration_match import device_mismatch, fit_to_device, unused_streams
from share.recordings.recording import Source
from share.recordings.trajectory import Trajectory
from share.sensors.imu_check import ImuRange
from share.sensors.measurement import CAM0, Measurement
from share.sensors.sequencer import rig_streams
from share.types import I64

MAX_WAITING_FRAMES = 2  # for the tracker


def choose_rig(
    calibration: Calibration | None, factory: Rig, serial: str | None
) -> tuple[Rig, tuple[str, ...]]:
    """Return the rig to use, from `calibration` or else `factory`, and warnings for the user. Raises
    UsageError if the calibration cannot fit this camera in its mode."""
    if calibration is None:
        return factory, ()
    try:
        rig = fit_to_device(calibration.rig, factory)
    except ValueError as error:
        raise UsageError(f"{calibration.where}: {error}") from None
    delivered = {name: name for name in rig_streams(factory)}
    return rig, unused_streams(delivered, rig) + device_mismatch(calibration.serials, serial)


class LiveSource(Source):
    """A live camera. The constructor opens it; the end of `measurements` disconnects it.

    Raises UsageError, ShareError or DataError if it cannot be opened, or does not fit the calibration.
    """

    reports_silence = True

    def __init__(
        self,
        feed: CameraFeed,
        rate_hz: float,
        calibration: Calibration | None = None,
        imu_range: ImuRange | None = None,
    ) -> None:
        """rate_hz: of cam0. calibration: in place of the factory's. imu_range: None if unknown."""
        self.imu_range = imu_range or Source.imu_range
        factory = feed.open()
        self.feed, self.rate_hz = feed, rate_hz
        self.name, self.serial = f"realsense:{feed.serial}", feed.serial
        try:
            self.rig, self.notes = choose_rig(calibration, factory, feed.serial)
        except BaseException:
            feed.close()
            raise

    def stamps(self) -> dict[str, I64]:
        raise UsageError(f"{self.name}: a live camera has no known stamps; record it first")

    def measurements(self) -> Iterator[Measurement]:
        """Yield measurements; may be called once."""
        return self.feed.measurements()

    def truth(self) -> Trajectory | None:
        return None

    def stop(self) -> None:
        self.feed.stop()

    def close(self) -> None:
        """Disconnect the camera, whether it was read or not."""
        self.feed.close()

    def report(self) -> dict[str, Any]:
        return {"camera": self.feed.report()}

    @property
    def images_count(self) -> int:
        return self.feed.processor.streams[CAM0].samples
