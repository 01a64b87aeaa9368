"""What a program gives, checked before anything computes with it: arguments, images, IMU samples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from share.config import Config
from share.errors import UsageError
from share.geometry.camera import Camera, Rig
from share.recordings.images import ArrayImage
from share.sensors.measurement import CAM0, CAM1, DEPTH, IMU, Measurement
from share.types import Frame, ImuBatch

_LIMIT_NS = 2**62
_MIN_RATE_HZ, _MAX_RATE_HZ = 0.1, 1000.0  # of images
V = TypeVar("V")


def checked_kind(name: str, value: V, kind: type | tuple[type, ...], expected: str) -> V:
    """Return `value`. Raises UsageError if it is not of this kind."""
    if not isinstance(value, kind):
        raise UsageError(f"{name}: is a {type(value).__name__}, expected {expected}")
    return value


def checked_call(name: str, value: V) -> V:
    """Return a function. Raises UsageError if it cannot be called."""
    if not callable(value):
        raise UsageError(f"{name}: is a {type(value).__name__}, expected a function")
    return value


def checked_path(name: str, path: str | Path) -> Path:
    """Return a path. Raises UsageError if it is none that a system may have."""
    text = str(checked_kind(name, path, (str, Path), "a path"))
    if "\0" in text or max(len(part.encode(errors="replace")) for part in text.split("/")) > 255:
        raise UsageError(f"{name}: {_quoted(text)} is no path: a name in it is too long, or has a NUL")
    return Path(path)


def checked_config(config: Config | None) -> Config:
    """Return settings, by default all defaults. Raises UsageError if they are none."""
    return Config() if config is None else checked_kind("config", config, Config, "a Config")


def checked_frames(frames: slice | None) -> slice | None:
    """Return a choice of frames. Raises UsageError unless it is a slice of whole numbers."""
    if frames is None:
        return None
    checked_kind("frames", frames, slice, "a slice, such as slice(0, 100)")
    numbers = (frames.start, frames.stop, frames.step)
    if not all(one is None or isinstance(one, int | np.integer) for one in numbers) or frames.step == 0:
        raise UsageError(f"frames: {_quoted(frames)} is none; give whole numbers, such as slice(0, 100)")
    return frames


def checked_rate_hz(rate_hz: float, may_be_unknown: bool = False) -> float:
    """Return the rate of images. may_be_unknown: it may be 0. Raises UsageError if no camera has it."""
    is_number = isinstance(rate_hz, int | float | np.integer | np.floating) and not isinstance(rate_hz, bool)
    if may_be_unknown and is_number and rate_hz == 0:
        return 0.0
    if not is_number or not _MIN_RATE_HZ <= rate_hz <= _MAX_RATE_HZ:
        raise UsageError(f"rate_hz: {_quoted(rate_hz)} is outside {_MIN_RATE_HZ:g} .. {_MAX_RATE_HZ:g} Hz")
    return float(rate_hz)


def checked_stamp_ns(stamp_ns: int) -> int:
    """Raises UsageError if `stamp_ns` is not an integer number of nanoseconds."""
    if isinstance(stamp_ns, bool) or not isinstance(stamp_ns, int | np.integer):
        raise UsageError(f"stamp_ns: {_quoted(stamp_ns)} is not an integer; give nanoseconds, round(1e9 * t)")
    if not 0 <= stamp_ns < _LIMIT_NS:
        raise UsageError(f"stamp_ns: {_quoted(stamp_ns)} is out of range; give nanoseconds from 0 on")
    return int(stamp_ns)


def imu_sample(rig: Rig, stamp_ns: int, gyro: ArrayLike, accel: ArrayLike) -> Measurement:
    """Return an IMU sample of a rig. gyro (3,) rad/s, accel (3,) m/s^2, which at rest is 9.81 upwards. Raises
    UsageError."""
    if rig.imu is None:
        raise UsageError("gyro: the rig has no IMU; load a calibration with Kalibr's IMU chain")
    values: list[float] = []
    for name, value in (("gyro", gyro), ("accel", accel)):
        values += _three_numbers(name, value)
    return Measurement(IMU, checked_stamp_ns(stamp_ns), values)


def _three_numbers(name: str, value: ArrayLike) -> list[float]:
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths
        raise UsageError(f"{name}: {_quoted(value)} is no array, expected three numbers x, y, z") from None
    if array.dtype.kind not in "iuf":
        raise UsageError(f"{name}: {_quoted(value)} are no numbers, expected three, x, y, z")
    if array.shape != (3,):
        raise UsageError(f"{name}: has shape {array.shape}, expected three numbers x, y, z")
    return [float(one) for one in array]


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
    """Raises UsageError if it is no frame, or its images do not fit the rig."""
    checked_kind("frame", frame, Frame, "a Frame")
    checked_kind("imu", frame.imu, ImuBatch, "an ImuBatch")
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


def _quoted(value: object) -> str:
    """Return a value as an error line quotes it."""
    try:
        text = str(value) if isinstance(value, np.generic) else repr(value)
    except ValueError:  # an integer of over 4300 digits
        return f"a {type(value).__name__} of many digits"
    return " ".join(text.split())[:60]


def _shape_text(shape: Sequence[int]) -> str:
    return "x".join(map(str, shape))
