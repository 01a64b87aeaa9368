"""Gray JPEG and PNG images and 16-bit depth PNGs, encoded and decoded; a damaged image raises.

An image is decoded only if its header states a sensible size. libjpeg fills a truncated image with gray, so
end markers are checked first; PNG checksums are verified, because a decoder may return half a depth map.
"""

from __future__ import annotations

import zlib
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from share.errors import DataError
from share.geometry.camera import MAX_PIXELS
from share.types import F32, U8

ADVICE = "record or copy it again, or remove it from the list"
_TAIL_BYTES = 64  # where the end marker must be; padding may follow it
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_MAX_SCANS = 200  # of a JPEG; progressive ones have ten, and each costs as much as a whole image

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # DataError reports what is wrong


def decode_gray(data: bytes, where: str) -> U8:
    """Decode a JPEG or PNG, gray or colour, to (H, W) uint8. Raises DataError."""
    return np.asarray(_decode(data, cv2.IMREAD_GRAYSCALE, where), np.uint8)


def decode_depth(data: bytes, depth_scale: float, where: str) -> F32:
    """Decode a 16-bit PNG to (H, W) float32, m, 0 = no reading. Raises DataError."""
    if not checked_header(data, where).is_depth:
        raise DataError(f"{where}: depth must have one 16-bit channel and be a PNG; {ADVICE}")
    return depth_metres(_decode(data, cv2.IMREAD_UNCHANGED, where), depth_scale, where)


def _decode(data: bytes, flags: int, where: str) -> NDArray[Any]:
    header = checked_header(data, where)
    if not 0 < header.width * header.height <= MAX_PIXELS or header.scans > _MAX_SCANS:
        raise DataError(
            f"{where}: the header claims {header.width}x{header.height} pixels in {header.scans} scans, more "
            f"than any camera takes; {ADVICE}"
        )
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (cv2.error, MemoryError):
        image = None
    if image is None:
        raise DataError(f"{where}: the image cannot be decoded; {ADVICE}")
    return np.asarray(image)


def checked_header(data: bytes, where: str) -> ImageHeader:
    header = image_header(data)
    if header is None:
        raise DataError(f"{where}: the image cannot be decoded: its header is damaged; {ADVICE}")
    return header


def depth_metres(raw: NDArray[Any], depth_scale: float, where: str) -> F32:
    """Convert (H, W) uint16 to float32, m. Raises DataError."""
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise DataError(f"{where}: depth must have one 16-bit channel, found {raw.dtype} {raw.shape}")
    return np.asarray(raw / np.float32(depth_scale), np.float32)


def encode_jpeg(image: U8, quality: int, is_optimized: bool = False) -> bytes:
    """Encode (H, W) uint8 as JPEG. is_optimized: with Huffman tables of its own, 8 to 16 % smaller in twice
    the time."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, int(is_optimized)]
    return bytes(cv2.imencode(".jpg", image, options)[1])


def image_format(data: bytes) -> str:
    """Return `png` or `jpg`."""
    return "png" if data[:8] == _PNG_MAGIC else "jpg"


def encode_png(image: U8) -> bytes:
    """Encode (H, W) uint8 as PNG, lossless."""
    return bytes(cv2.imencode(".png", image)[1])


def check_complete(data: bytes, where: str) -> None:
    """Raise DataError unless `data` is a JPEG or PNG with its first and its last marker."""
    if data[:2] == b"\xff\xd8":
        complete = b"\xff\xd9" in data[-_TAIL_BYTES:]
    elif data[:8] == _PNG_MAGIC:
        complete = b"IEND" in data[-_TAIL_BYTES:] and _is_png_intact(data)
    elif not data:
        raise DataError(f"{where}: the image is empty; {ADVICE}")
    else:
        raise DataError(f"{where}: is neither JPEG nor PNG; convert it, or record again")
    if not complete:
        raise DataError(f"{where}: the image is cut short or damaged; {ADVICE}")


def _is_png_intact(data: bytes) -> bool:
    """Return whether every chunk's CRC is right (PNG specification, 5.3)."""
    offset = 8
    while offset + 12 <= len(data):
        end = offset + 8 + int.from_bytes(data[offset : offset + 4], "big")
        if zlib.crc32(data[offset + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return False
        if data[offset + 4 : offset + 8] == b"IEND":
            return True
        offset = end + 4
    return False


# ---- Headers of JPEG and PNG, parsed before a decoder sees the image

_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # those are tables (ITU T.81, B.1.1.3)
_BARE_MARKERS = frozenset((0x01, *range(0xD0, 0xD9)))  # without a length
_SEQUENTIAL_MARKERS = frozenset((0xC0, 0xC1))
_END_MARKER = 0xD9
_SCAN_MARKER = b"\xff\xda"
_GRAY_16 = (16, 0)  # bits, colour type (PNG 11.2.2)


class ImageHeader(NamedTuple):
    """width, height: px. is_depth: a PNG with one 16-bit channel. scans: most passes over a JPEG's image that
    decoding takes."""

    width: int
    height: int
    is_depth: bool
    scans: int = 1


def image_header(data: bytes) -> ImageHeader | None:
    """Parse the header of a JPEG or PNG; None if damaged, or of another format."""
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
    """Parse the segments up to the first scan; exactly one of them must be a frame header."""
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
    """Parse the frame header at `frame`. If the first scan, at `scan`, has all components of a sequential
    frame, a decoder reads only that one; else the scans are counted, which takes a moment."""
    height, width = (int.from_bytes(data[k : k + 2], "big") for k in (frame + 5, frame + 7))
    is_single_scan = data[frame + 1] in _SEQUENTIAL_MARKERS and data[frame + 9] == data[scan + 4]
    return ImageHeader(width, height, False, 1 if is_single_scan else data.count(_SCAN_MARKER))
