"""Convert ROS 2 messages `sensor_msgs/Image` and `CompressedImage` to lazy images and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from share.errors import DataError
from share.geometry.camera import Camera
from share.recordings.images import EncodedImage, check_header_size, depth_metres, image_format
from share.recordings.mcap import ros_messages as ros
from share.types import F32

MILLIMETRES = 1000.0  # 16UC1 depth is in mm, 32FC1 in m: ROS REP 118
_MAX_DEPTH_M = 1e4  # beyond any depth camera
_TO_GRAY = {
    "bgr8": cv2.COLOR_BGR2GRAY,
    "8UC3": cv2.COLOR_BGR2GRAY,
    "rgb8": cv2.COLOR_RGB2GRAY,
    "bgra8": cv2.COLOR_BGRA2GRAY,
    "8UC4": cv2.COLOR_BGRA2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY,
}
_CHANNELS = {"mono8": 1, "8UC1": 1, "bgr8": 3, "8UC3": 3, "rgb8": 3, "bgra8": 4, "8UC4": 4, "rgba8": 4}
_DEPTH_TYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


@dataclass(frozen=True, slots=True, eq=False)
class RawImage:
    """A `sensor_msgs/Image`, converted when loaded."""

    message: Any
    where: str
    camera: Camera
    is_depth: bool

    def load(self) -> NDArray[Any]:
        message, camera = self.message, self.camera
        check_header_size(message.width, message.height, camera.width, camera.height, self.where)
        return self._depth() if self.is_depth else self._gray()

    def _gray(self) -> NDArray[Any]:
        encoding = self.message.encoding
        if encoding not in _CHANNELS:
            raise DataError(
                f"{self.where}: encoding '{encoding}' is not supported; supported: {', '.join(_CHANNELS)}"
            )
        pixels = self._pixels("u1", _CHANNELS[encoding])
        return (
            pixels[..., 0] if pixels.shape[2] == 1 else np.asarray(cv2.cvtColor(pixels, _TO_GRAY[encoding]))
        )

    def _depth(self) -> F32:
        encoding = self.message.encoding
        if encoding not in _DEPTH_TYPES:
            raise DataError(
                f"{self.where}: depth encoding '{encoding}' is not supported; "
                f"supported: {', '.join(_DEPTH_TYPES)}"
            )
        order = ">" if self.message.is_bigendian else "<"
        pixels = self._pixels(order + _DEPTH_TYPES[encoding], 1)[..., 0]
        if encoding != "32FC1":
            return depth_metres(pixels.astype(np.uint16), MILLIMETRES, self.where)
        metres = pixels.astype(np.float32)
        return np.where((metres > 0) & (metres < _MAX_DEPTH_M), metres, np.float32(0))

    def _pixels(self, dtype: str, channels: int) -> NDArray[Any]:
        """Return (H, W, channels) without the padding of rows. Raises DataError if data is missing."""
        height, width, step = self.message.height, self.message.width, self.message.step
        row = width * channels * np.dtype(dtype).itemsize
        data = np.ascontiguousarray(self.message.data)
        if step < row or len(data) < height * step:
            raise DataError(f"{self.where}: the image is cut short: {len(data)} of {height * step} bytes")
        rows = data[: height * step].reshape(height, step)[:, :row]
        return np.ascontiguousarray(rows).view(dtype).reshape(height, width, channels)


def decode_compressed(message: Any, where: str, camera: Camera, is_depth: bool) -> EncodedImage:
    """Convert a `CompressedImage`: JPEG or PNG; depth is a PNG, after a header if its format says so."""
    data = message.data.tobytes()
    if is_depth:
        if "rvl" in message.format.lower():
            raise DataError(f"{where}: RVL depth is not supported; record depth as PNG or raw")
        if "compressedDepth" in message.format:
            data = data[ros.DEPTH_HEADER_BYTES :]
    return EncodedImage(data, where, camera.width, camera.height, MILLIMETRES if is_depth else 0.0)


def encode_compressed(header: Any, data: bytes, is_depth: bool) -> Any:
    """Make a `CompressedImage` of JPEG or PNG bytes; depth (16-bit PNG, mm) gets image_transport's header."""
    kind = "png" if image_format(data) == "png" else "jpeg"
    if is_depth:
        data, kind = bytes(ros.DEPTH_HEADER_BYTES) + data, "16UC1; compressedDepth png"
    return ros.make_message(ros.COMPRESSED, header=header, format=kind, data=np.frombuffer(data, np.uint8))


def encode_raw(header: Any, image: NDArray[Any]) -> Any:
    """Make an `Image`: (H, W) uint8 as mono8; float32 m as 16UC1 mm if that is exact, else 32FC1."""
    if image.dtype == np.uint8:
        encoding = "mono8"
    else:
        encoding, image = _depth_encoding(image)
    image = np.ascontiguousarray(image)
    return ros.make_message(
        ros.IMAGE,
        header=header,
        height=image.shape[0],
        width=image.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=image.strides[0],
        data=image.view(np.uint8).reshape(-1),
    )


def _depth_encoding(depth: F32) -> tuple[str, NDArray[Any]]:
    mm = np.clip(np.rint(depth * np.float32(MILLIMETRES)), 0, 65535).astype(np.uint16)
    if np.array_equal(mm / np.float32(MILLIMETRES), depth):
        return "16UC1", mm
    return "32FC1", depth
