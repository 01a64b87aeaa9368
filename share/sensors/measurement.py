"""Samples of single sensors, before the sequencer merges them into frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

CAM0, CAM1, DEPTH, IMU = "cam0", "cam1", "depth", "imu"
STREAMS = (CAM0, CAM1, DEPTH, IMU)

ImuSample = Sequence[float]  # six: gyro rad/s, accel m/s^2, body frame


class LazyImage(Protocol):
    """An image that is decoded on demand, so that decoding can be timed separately or skipped."""

    def load(self) -> NDArray[Any]:
        """Decode to (H, W) uint8 gray, or (H, W) float32 depth, m, 0 = no reading. Raises DataError."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """One sample of one stream. payload: a LazyImage for cam0, cam1 and depth, an ImuSample for imu."""

    stream: str
    stamp_ns: int
    payload: Any
