"""What sensors deliver, one sample at a time, before it is merged into frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

CAM0, CAM1, DEPTH, IMU = "cam0", "cam1", "depth", "imu"
STREAMS = (CAM0, CAM1, DEPTH, IMU)

ImuSample = Sequence[float]  # six: gyro rad/s, accel m/s^2, body frame


class LazyImage(Protocol):
    """An image that is decoded when someone asks, so that decoding is timed apart or skipped."""

    def load(self) -> NDArray[Any]:
        """(H, W) uint8 gray, or (H, W) float32 depth in m with 0 = no reading. Raises DataError."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """One sample of one stream: cam0, cam1 and depth carry a LazyImage, imu an ImuSample."""

    stream: str
    stamp_ns: int
    payload: Any
