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

from share.errors import CalibrationMismatchError, DataError
from share.files.reading import MB, read_bytes
from share.geometry.camera import MAX_PIXELS, Camera
from share.sensors.sequencer import UndecodedFrame
from share.types import F32, U8, Frame

_ADVICE = "record or copy it again, or take it out of the list"
_TAIL_BYTES = 64  # bytes in which an end marker may be followed by padding
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_MAX_BYTES_PER_PIXEL = 16  # of a file for each pixel: four channels of 16 bits, twice
_MAX_SCANS = 200  # of a JPEG; progressive ones have ten, and each costs as much as a whole image

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
        max_bytes = _MAX_BYTES_PER_PIXEL * self.width * self.height + MB
        data = self.data if isinstance(self.data, bytes) else _read_file(self.data, max_bytes)
        check_complete(data, self.where)
        return data

    def check(self) -> None:
        """Raises DataError unless it is whole and of the calibration's size, as far as that is known without
        its pixels."""
        header = _checked_header(self.read(), self.where)
        check_header_size(header.width, header.height, self.width, self.height, self.where)

    def load(self) -> NDArray[Any]:
        data = self.read()
        header = _checked_header(data, self.where)
        check_header_size(header.width, header.height, self.width, self.height, self.where)
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


def decode_frame(undecoded: UndecodedFrame) -> Frame:
    """Decode the images of a bundle. Raises DataError naming the image that is damaged."""
    return Frame(
        stamp_ns=undecoded.stamp_ns,
        index=undecoded.index,
        image0=undecoded.image0.load(),
        image1=None if undecoded.image1 is None else undecoded.image1.load(),
        depth=None if undecoded.depth is None else undecoded.depth.load(),
        imu=undecoded.imu,
        gap_ns=undecoded.gap_ns,
    )


def decode_gray(data: bytes, where: str) -> U8:
    """JPEG or PNG, gray or colour -> (H, W) uint8."""
    return np.asarray(_decode(data, cv2.IMREAD_GRAYSCALE, where), np.uint8)


def decode_depth(data: bytes, depth_scale: float, where: str) -> F32:
    """16-bit PNG -> (H, W) float32 m, 0 = no reading."""
    if not _checked_header(data, where).is_depth:
        raise DataError(f"{where}: depth must have one 16-bit channel and be a PNG; {_ADVICE}")
    return depth_metres(_decode(data, cv2.IMREAD_UNCHANGED, where), depth_scale, where)


def _decode(data: bytes, flags: int, where: str) -> NDArray[Any]:
    header = _checked_header(data, where)
    if not 0 < header.width * header.height <= MAX_PIXELS or header.scans > _MAX_SCANS:
        raise DataError(
            f"{where}: says that it has {header.width}x{header.height} pixels in {header.scans} scans, "
            f"which no camera takes; {_ADVICE}"
        )
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (cv2.error, MemoryError):
        image = None
    if image is None:
        raise DataError(f"{where}: the image cannot be decoded; {_ADVICE}")
    return np.asarray(image)


def _checked_header(data: bytes, where: str) -> ImageHeader:
    header = image_header(data)
    if header is None:
        raise DataError(f"{where}: the image cannot be decoded: its header is damaged; {_ADVICE}")
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
    check_header_size(image.shape[1], image.shape[0], width, height, where)
    return image


def check_header_size(found_width: int, found_height: int, width: int, height: int, where: str) -> None:
    """Raises MisfitError for an image of another size than the calibration's; its pixels are not touched."""
    if (found_width, found_height) != (width, height):
        raise CalibrationMismatchError(
            f"{where}: is {found_width}x{found_height}, but the calibration is for {width}x{height}; "
            "give the calibration of this recording with --calib"
        )


def check_complete(data: bytes, where: str) -> None:
    """Raises DataError unless `data` is a JPEG or PNG from its first marker to its last."""
    if data[:2] == b"\xff\xd8":
        complete = b"\xff\xd9" in data[-_TAIL_BYTES:]
    elif data[:8] == _PNG_MAGIC:
        complete = b"IEND" in data[-_TAIL_BYTES:] and _is_png_intact(data)
    elif not data:
        raise DataError(f"{where}: the image is empty; {_ADVICE}")
    else:
        raise DataError(f"{where}: is neither JPEG nor PNG; convert it, or record again")
    if not complete:
        raise DataError(f"{where}: the image is cut short or damaged; {_ADVICE}")


def _is_png_intact(data: bytes) -> bool:
    """Whether every chunk's CRC holds (PNG specification, 5.3)."""
    offset = 8
    while offset + 12 <= len(data):
        end = offset + 8 + int.from_bytes(data[offset : offset + 4], "big")
        if zlib.crc32(data[offset + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return False
        if data[offset + 4 : offset + 8] == b"IEND":
            return True
        offset = end + 4
    return False


def read_picture(path: Path) -> bytes:
    """A picture without a calibration that says how large it is. Raises DataError."""
    return _read_file(path, _MAX_BYTES_PER_PIXEL * MAX_PIXELS)


def _read_file(path: Path, max_bytes: int) -> bytes:
    try:
        return read_bytes(path, max_bytes)
    except FileNotFoundError:
        raise DataError(f"{path}: the image is listed but missing; {_ADVICE}") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None


# ---- What a JPEG or PNG says it is, before a decoder sees it. Pure: bytes in, numbers out.

_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {
    0xC4,
    0xC8,
    0xCC,
}  # frames; the others are tables (ITU T.81, B.1.1.3)
_BARE_MARKERS = frozenset((0x01, *range(0xD0, 0xD9)))  # markers without a length
_SEQUENTIAL_MARKERS = frozenset((0xC0, 0xC1))
_END_MARKER = 0xD9
_SCAN_MARKER = b"\xff\xda"
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
    return (
        _png_header(data)
        if data[:8] == _PNG_MAGIC
        else _jpeg_header(data)
        if data[:2] == b"\xff\xd8"
        else None
    )


def _png_header(data: bytes) -> ImageHeader | None:
    if len(data) < 33 or data[8:16] != b"\x00\x00\x00\rIHDR":
        return None
    width, height = (int.from_bytes(data[offset : offset + 4], "big") for offset in (16, 20))
    return ImageHeader(width, height, (data[24], data[25]) == _GRAY_16)


def _jpeg_header(data: bytes) -> ImageHeader | None:
    """From its segments up to the first scan, among which there is one frame header."""
    offset, frame = 2, 0
    while offset + 10 <= len(data) and data[offset] == 0xFF:
        marker = data[offset + 1]
        if marker == 0xFF:  # padding
            offset += 1
            continue
        if marker in _BARE_MARKERS:
            offset += 2
            continue
        if marker == _SCAN_MARKER[1]:
            return _jpeg_frame_header(data, frame, offset) if frame else None
        if marker == _END_MARKER or (frame and marker in _FRAME_MARKERS):
            return None
        frame = offset if marker in _FRAME_MARKERS else frame
        offset += 2 + max(2, int.from_bytes(data[offset + 2 : offset + 4], "big"))
    return None


def _jpeg_frame_header(data: bytes, frame: int, scan: int) -> ImageHeader:
    """One scan is all there is where it has all components of a frame that is not progressive: a decoder
    stops there. Else scans are counted, which takes a moment."""
    height, width = (int.from_bytes(data[k : k + 2], "big") for k in (frame + 5, frame + 7))
    is_single_scan = data[frame + 1] in _SEQUENTIAL_MARKERS and data[frame + 9] == data[scan + 4]
    return ImageHeader(width, height, False, 1 if is_single_scan else data.count(_SCAN_MARKER))
