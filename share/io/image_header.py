"""What a JPEG or PNG says it is, before a decoder sees it. Pure: bytes in, numbers out."""

from __future__ import annotations

from typing import NamedTuple

_PNG = b"\x89PNG\r\n\x1a\n"
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
    return _png(data) if data[:8] == _PNG else _jpeg(data) if data[:2] == b"\xff\xd8" else None


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
    """One scan is all there is where it has all components of a frame that is not progressive: a decoder looks
    no further. Else scans are counted, which takes a moment."""
    height, width = (int.from_bytes(data[k : k + 2], "big") for k in (frame + 5, frame + 7))
    whole = data[frame + 1] in _SEQUENTIAL and data[frame + 9] == data[scan + 4]
    return ImageHeader(width, height, False, 1 if whole else data.count(_SCAN))
