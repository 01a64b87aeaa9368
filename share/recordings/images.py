"""Encoded images to arrays: gray uint8, or depth as float32 metres. Damage is found, never shown.

Nothing is decoded before its header says that it is as large as it should be. libjpeg fills a truncated
image with gray and goes on, so end markers are looked for first; PNG checksums are verified, because a
decoder may hand out half a depth map.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from share.errors import DataError, MisfitError
from share.files.reading import MB, read_bytes
from share.geometry.camera import MOST_PIXELS, Camera
from share.sensors.sequencer import Bundle
from share.types import F32, U8, Frame

_MEND = "record or copy it again, or take it out of the list"
_TAIL = 64  # bytes in which an end marker may be followed by padding
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_MOST_BYTES = 16  # of a file for each pixel: four channels of 16 bits, twice
_MOST_SCANS = 200  # of a JPEG; progressive ones have ten, and each costs as much as a whole image

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what is wrong is said once, by DataError


@dataclass(frozen=True, slots=True, eq=False)
class EncodedImage:
    """A JPEG or PNG in a file (`data` is its path) or in memory (bytes), with where it came from.

    width, height: what the calibration says. depth_scale: units per metre of a 16-bit depth PNG,
    0 for a gray or colour image.
    """

    data: Path | bytes
    where: str
    width: int
    height: int
    depth_scale: float = 0.0

    def read(self) -> bytes:
        """The encoded bytes. Raises DataError if the file is missing or the image is cut short."""
        most = _MOST_BYTES * self.width * self.height + MB
        data = self.data if isinstance(self.data, bytes) else _read_file(self.data, most)
        check_complete(data, self.where)
        return data

    def check(self) -> None:
        """Raises DataError unless it is whole and of the calibration's size, as far as that is known without
        its pixels."""
        header = _header(self.read(), self.where)
        check_said(header.width, header.height, self.width, self.height, self.where)

    def load(self) -> NDArray[Any]:
        data = self.read()
        header = _header(data, self.where)
        check_said(header.width, header.height, self.width, self.height, self.where)
        image = (
            decode_depth(data, self.depth_scale, self.where)
            if self.depth_scale
            else decode_gray(data, self.where)
        )
        return check_size(image, self.width, self.height, self.where)


@dataclass(frozen=True, slots=True, eq=False)
class ArrayImage:
    """An image that needs no decoding: (H, W) uint8 or float32 m."""

    array: NDArray[Any]

    def load(self) -> NDArray[Any]:
        return self.array


def file_image(path: Path, camera: Camera, depth_scale: float = 0.0) -> EncodedImage:
    """A lazily read image file of `camera`."""
    return EncodedImage(path, str(path), camera.width, camera.height, depth_scale)


def load(bundle: Bundle) -> Frame:
    """Decode the images of a bundle. Raises DataError naming the image that is damaged."""
    return Frame(
        stamp_ns=bundle.stamp_ns,
        index=bundle.index,
        image0=bundle.image0.load(),
        image1=None if bundle.image1 is None else bundle.image1.load(),
        depth=None if bundle.depth is None else bundle.depth.load(),
        imu=bundle.imu,
        gap_ns=bundle.gap_ns,
    )


def decode_gray(data: bytes, where: str) -> U8:
    """JPEG or PNG, gray or colour -> (H, W) uint8."""
    return np.asarray(_decoded(data, cv2.IMREAD_GRAYSCALE, where), np.uint8)


def decode_depth(data: bytes, depth_scale: float, where: str) -> F32:
    """16-bit PNG -> (H, W) float32 m, 0 = no reading."""
    if not _header(data, where).is_depth:
        raise DataError(f"{where}: depth must have one 16-bit channel and be a PNG; {_MEND}")
    return depth_metres(_decoded(data, cv2.IMREAD_UNCHANGED, where), depth_scale, where)


def _decoded(data: bytes, how: int, where: str) -> NDArray[Any]:
    header = _header(data, where)
    if not 0 < header.width * header.height <= MOST_PIXELS or header.scans > _MOST_SCANS:
        raise DataError(
            f"{where}: says that it has {header.width}x{header.height} pixels in {header.scans} scans, "
            f"which no camera takes; {_MEND}"
        )
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), how)
    except (cv2.error, MemoryError):
        image = None
    if image is None:
        raise DataError(f"{where}: the image cannot be decoded; {_MEND}")
    return np.asarray(image)


def _header(data: bytes, where: str) -> ImageHeader:
    header = image_header(data)
    if header is None:
        raise DataError(f"{where}: the image cannot be decoded: its header is damaged; {_MEND}")
    return header


def depth_metres(raw: NDArray[Any], depth_scale: float, where: str) -> F32:
    """(H, W) uint16 -> float32 m."""
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise DataError(f"{where}: depth must have one 16-bit channel, found {raw.dtype} {raw.shape}")
    return np.asarray(raw / np.float32(depth_scale), np.float32)


def encode_jpeg(image: U8, quality: int) -> bytes:
    """(H, W) uint8 -> JPEG."""
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])


def image_format(data: bytes) -> str:
    """`png` or `jpg`."""
    return "png" if data[:8] == _PNG_MAGIC else "jpg"


def encode_png(image: U8) -> bytes:
    """(H, W) uint8 -> PNG, lossless."""
    return bytes(cv2.imencode(".png", image)[1])


def check_size(image: NDArray[Any], width: int, height: int, where: str) -> NDArray[Any]:
    """`image` if it is as large as the calibration says, else MisfitError."""
    check_said(image.shape[1], image.shape[0], width, height, where)
    return image


def check_said(found_width: int, found_height: int, width: int, height: int, where: str) -> None:
    """Raises MisfitError for an image of another size than the calibration's; its pixels are not touched."""
    if (found_width, found_height) != (width, height):
        raise MisfitError(
            f"{where}: is {found_width}x{found_height}, but the calibration is for {width}x{height}; "
            "give the calibration of this recording with --calib"
        )


def check_complete(data: bytes, where: str) -> None:
    """Raises DataError unless `data` is a JPEG or PNG from its first marker to its last."""
    if data[:2] == b"\xff\xd8":
        complete = b"\xff\xd9" in data[-_TAIL:]
    elif data[:8] == _PNG_MAGIC:
        complete = b"IEND" in data[-_TAIL:] and _png_sound(data)
    elif not data:
        raise DataError(f"{where}: the image is empty; {_MEND}")
    else:
        raise DataError(f"{where}: is neither JPEG nor PNG; convert it, or record again")
    if not complete:
        raise DataError(f"{where}: the image is cut short or damaged; {_MEND}")


def _png_sound(data: bytes) -> bool:
    """Whether every chunk's CRC holds (PNG specification, 5.3)."""
    at = 8
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end + 4
    return False


def read_picture(path: Path) -> bytes:
    """A picture without a calibration that says how large it is. Raises DataError."""
    return _read_file(path, _MOST_BYTES * MOST_PIXELS)


def _read_file(path: Path, most: int) -> bytes:
    try:
        return read_bytes(path, most)
    except FileNotFoundError:
        raise DataError(f"{path}: the image is listed but missing; {_MEND}") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None


# ---- What a JPEG or PNG says it is, before a decoder sees it. Pure: bytes in, numbers out.

_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # frames; the others are tables (ITU T.81, B.1.1.3)
_BARE = frozenset((0x01, *range(0xD0, 0xD9)))  # markers without a length
_SEQUENTIAL = frozenset((0xC0, 0xC1))
_END = 0xD9
_SCAN = b"\xff\xda"
_GRAY_16 = (16, 0)  # bits, colour type (PNG 11.2.2)


class ImageHeader(NamedTuple):
    """width, height in pixels; is_depth: a PNG with one channel of 16 bits; scans: passes over a JPEG's
    image that decoding takes, at most."""

    width: int
    height: int
    is_depth: bool
    scans: int = 1


def image_header(data: bytes) -> ImageHeader | None:
    """None where it does not say, or is neither."""
    return _png(data) if data[:8] == _PNG_MAGIC else _jpeg(data) if data[:2] == b"\xff\xd8" else None


def _png(data: bytes) -> ImageHeader | None:
    if len(data) < 33 or data[8:16] != b"\x00\x00\x00\rIHDR":
        return None
    width, height = (int.from_bytes(data[at : at + 4], "big") for at in (16, 20))
    return ImageHeader(width, height, (data[24], data[25]) == _GRAY_16)


def _jpeg(data: bytes) -> ImageHeader | None:
    """From its segments up to the first scan, among which there is one frame header."""
    at, frame = 2, 0
    while at + 10 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # padding
            at += 1
            continue
        if marker in _BARE:
            at += 2
            continue
        if marker == _SCAN[1]:
            return _of_frame(data, frame, at) if frame else None
        if marker == _END or (frame and marker in _SOF):
            return None
        frame = at if marker in _SOF else frame
        at += 2 + max(2, int.from_bytes(data[at + 2 : at + 4], "big"))
    return None


def _of_frame(data: bytes, frame: int, scan: int) -> ImageHeader:
    """One scan is all there is where it has all components of a frame that is not progressive: a decoder
    stops there. Else scans are counted, which takes a moment."""
    height, width = (int.from_bytes(data[k : k + 2], "big") for k in (frame + 5, frame + 7))
    whole = data[frame + 1] in _SEQUENTIAL and data[frame + 9] == data[scan + 4]
    return ImageHeader(width, height, False, 1 if whole else data.count(_SCAN))
