"""Images and IMU samples of a program's own camera, checked before anything computes with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from share.errors import UsageError
from share.geometry.camera import Camera, Rig
from share.recordings.images import ArrayImage
from share.sensors.measurement import CAM0, CAM1, DEPTH, IMU, Measurement
from share.types import Frame

_LIMIT_NS = 2**62


def checked_stamp_ns(stamp_ns: int) -> int:
    """Raises UsageError if `stamp_ns` is not an integer number of nanoseconds."""
    if isinstance(stamp_ns, bool) or not isinstance(stamp_ns, int | np.integer):
        raise UsageError(f"stamp_ns: {stamp_ns!r:.40} is not an integer; give nanoseconds, round(1e9 * t)")
    if not 0 <= stamp_ns < _LIMIT_NS:
        raise UsageError(f"stamp_ns: {stamp_ns} is out of range; give nanoseconds from 0 on")
    return int(stamp_ns)


def imu_sample(stamp_ns: int, gyro: ArrayLike, accel: ArrayLike) -> Measurement:
    """Return an IMU sample. gyro (3,) rad/s, accel (3,) m/s^2, which at rest is 9.81 upwards. Raises
    UsageError."""
    values: list[float] = []
    for name, value in (("gyro", gyro), ("accel", accel)):
        array = np.asarray(value, np.float64)
        if array.shape != (3,):
            raise UsageError(f"{name}: has shape {array.shape}, expected three numbers x, y, z")
        values += array.tolist()
    return Measurement(IMU, checked_stamp_ns(stamp_ns), values)


def image_samples(
    rig: Rig,
    stamp_ns: int,
    image0: NDArray[Any],
    image1: NDArray[Any] | None = None,
    depth: NDArray[Any] | None = None,
) -> Iterator[Measurement]:
    """Yield copies of the images of one moment, as `Frame` has them: those of `rig`'s cameras. Raises
    UsageError."""
    stamp = checked_stamp_ns(stamp_ns)
    given = {CAM0: image0, CAM1: image1, DEPTH: depth}
    cameras = rig.cameras
    if extra := [stream for stream, image in given.items() if image is not None and stream not in cameras]:
        raise UsageError(f"{_NAMES[extra[0]]}: the rig has no {extra[0]}; leave the image out")
    needed = [CAM0, CAM1 if CAM1 in cameras else DEPTH]
    if missing := [stream for stream in needed if stream in cameras and given[stream] is None]:
        raise UsageError(f"{_NAMES[missing[0]]}: is missing; the rig has {', '.join(cameras)}")
    checked = [
        (stream, _checked_image(stream, image, cameras[stream]))
        for stream, image in given.items()
        if image is not None
    ]
    for stream, image in checked:
        yield Measurement(stream, stamp, ArrayImage(image))


def check_frame(frame: Frame, rig: Rig) -> None:
    """Raises UsageError if the images of a frame do not fit the rig."""
    for _ in image_samples(rig, frame.stamp_ns, frame.image0, frame.image1, frame.depth):
        pass


_NAMES = {CAM0: "image0", CAM1: "image1", DEPTH: "depth"}


def _checked_image(stream: str, image: NDArray[Any], camera: Camera) -> NDArray[Any]:
    expected = np.float32 if stream == DEPTH else np.uint8
    if not isinstance(image, np.ndarray):
        raise UsageError(f"{_NAMES[stream]}: is a {type(image).__name__}, expected a numpy array")
    if image.shape != (camera.height, camera.width) or image.dtype != expected:
        hint = "metres" if stream == DEPTH else "convert colour to gray"
        raise UsageError(
            f"{_NAMES[stream]}: is {_shape_text(image.shape)} {image.dtype}, expected "
            f"{_shape_text((camera.height, camera.width))} {np.dtype(expected)} as calibrated ({hint})"
        )
    return np.array(image, order="C")  # the caller may use its buffer again


def _shape_text(shape: Sequence[int]) -> str:
    return "x".join(map(str, shape))
