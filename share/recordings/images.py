"""Images of recordings, decoded on demand: gray uint8 or depth float32 m, of the calibration's size."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from share.errors import CalibrationMismatchError
from share.files.reading import MB, read_bytes, read_errors
from share.geometry.camera import MAX_PIXELS, Camera
from share.sensors.sequencer import UndecodedFrame
from share.types import Frame
from share.vision.image_codec import ADVICE, check_complete, checked_header, decode_depth, decode_gray

_MAX_BYTES_PER_PIXEL = 16  # of a file: twice four channels of 16 bits


@dataclass(frozen=True, slots=True, eq=False)
class EncodedImage:
    """A JPEG or PNG in a file (`data` is its path) or in memory (bytes). where: its name in errors.

    width, height: of the calibration. depth_scale: units per metre of a 16-bit depth PNG, 0 for a gray or
    colour image.
    """

    data: Path | bytes
    where: str
    width: int
    height: int
    depth_scale: float = 0.0

    def read(self) -> bytes:
        """Return the encoded bytes. Raises DataError if the file is missing or the image is cut short."""
        max_bytes = _MAX_BYTES_PER_PIXEL * self.width * self.height + MB
        data = self.data if isinstance(self.data, bytes) else _read_file(self.data, max_bytes)
        check_complete(data, self.where)
        return data

    def check(self) -> bytes:
        """Return the encoded bytes of a complete image of the calibration's size, without decoding it. Raises
        DataError."""
        data = self.read()
        header = checked_header(data, self.where)
        check_size((header.width, header.height), (self.width, self.height), self.where)
        return data

    def load(self) -> NDArray[Any]:
        data, scale = self.check(), self.depth_scale
        image = decode_depth(data, scale, self.where) if scale else decode_gray(data, self.where)
        check_size(image.shape[::-1], (self.width, self.height), self.where)  # EXIF may turn it
        return image


@dataclass(frozen=True, slots=True, eq=False)
class ArrayImage:
    """An image that needs no decoding: (H, W) uint8 or float32 m."""

    array: NDArray[Any]

    def load(self) -> NDArray[Any]:
        return self.array


def file_image(path: Path, camera: Camera, depth_scale: float = 0.0) -> EncodedImage:
    """Return an image file of `camera`, to be read on demand."""
    return EncodedImage(path, str(path), camera.width, camera.height, depth_scale)


def decode_frame(undecoded: UndecodedFrame) -> Frame:
    """Decode the images of a frame. Raises DataError that names a damaged image."""
    return Frame(
        stamp_ns=undecoded.stamp_ns,
        index=undecoded.index,
        image0=undecoded.image0.load(),
        image1=None if undecoded.image1 is None else undecoded.image1.load(),
        depth=None if undecoded.depth is None else undecoded.depth.load(),
        imu=undecoded.imu,
        gap_ns=undecoded.gap_ns,
    )


def check_size(found: tuple[int, ...], expected: tuple[int, int], where: str) -> None:
    """Raise CalibrationMismatchError if an image's (width, height) is not the calibration's."""
    if found != expected:
        raise CalibrationMismatchError(
            f"{where}: is {found[0]}x{found[1]}, but the calibration is for {expected[0]}x{expected[1]}; "
            "give the calibration of this recording with --calib"
        )


def read_picture(path: Path) -> bytes:
    """Read the bytes of a picture of any size. Raises DataError."""
    return _read_file(path, _MAX_BYTES_PER_PIXEL * MAX_PIXELS)


def _read_file(path: Path, max_bytes: int) -> bytes:
    with read_errors(path, missing=f"the image is listed but missing; {ADVICE}"):
        return read_bytes(path, max_bytes)
