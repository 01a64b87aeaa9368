"""Conversion of SDK frames to samples. Pixels are copied at once, since the SDK has few buffers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from share.recordings.images import ArrayImage
from share.sensors.measurement import CAM0, CAM1, DEPTH
from share.sensors.sample_processor import ACCEL, GYRO, DeviceSample
from share.types import F32

_INTEGER_TOLERANCE = 1e-3  # of the inverse of a depth unit


def to_sample(rs: Any, frame: Any, depth_unit_m: float, arrived_ns: int, epoch: int) -> DeviceSample:
    """Return a sample: an image, a depth map (m) or three IMU values, with the device's stamp in whole µs."""
    stream = _stream_name(rs, frame.profile)
    motion = stream in (ACCEL, GYRO)
    return DeviceSample(
        stream=stream,
        stamp_ns=round(frame.timestamp * 1e3) * 1000,
        payload=_motion_values(frame) if motion else ArrayImage(_pixels(frame, stream, depth_unit_m)),
        arrived_ns=arrived_ns,
        number=None if motion else int(frame.frame_number),  # the IMU's two streams may share a counter
        is_device_clock=frame.frame_timestamp_domain == rs.timestamp_domain.hardware_clock,
        epoch=epoch,
    )


def has_dots(rs: Any, frame: Any) -> bool | None:
    """Return whether the emitter was on; None if the frame lacks the metadata."""
    metadata = rs.frame_metadata_value
    # Not the laser power, which is only a setting.
    for kind in (metadata.frame_emitter_mode, metadata.frame_laser_power_mode):
        if frame.supports_frame_metadata(kind):
            return bool(frame.get_frame_metadata(kind))
    return None


def _stream_name(rs: Any, profile: Any) -> str:
    kind = profile.stream_type()
    if kind == rs.stream.infrared:
        return CAM0 if profile.stream_index() == 1 else CAM1
    return {rs.stream.depth: DEPTH, rs.stream.accel: ACCEL, rs.stream.gyro: GYRO}[kind]


def _motion_values(frame: Any) -> list[float]:
    motion = frame.as_motion_frame().get_motion_data()
    return [motion.x, motion.y, motion.z]


def _pixels(frame: Any, stream: str, depth_unit_m: float) -> NDArray[Any]:
    pixels = np.asarray(frame.get_data())
    return scale_depth(pixels, depth_unit_m) if stream == DEPTH else pixels.copy()


def scale_depth(steps: NDArray[np.uint16], unit_m: float) -> F32:
    """Return depth (H, W) in m. The SDK gives the unit in single precision. A unit near 1/n m is taken as
    exactly that, by division, so that whole millimetres are exact to the last bit."""
    n = round(1 / unit_m)
    if n and abs(1 / unit_m - n) < _INTEGER_TOLERANCE:
        return np.asarray(steps / np.float32(n))
    return np.asarray(steps * np.float32(unit_m))
