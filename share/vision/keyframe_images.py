"""Images of keyframes, compressed to send and to keep."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from share.array_table import ArrayTable
from share.checks import MAX_SIGMA
from share.errors import DataError
from share.geometry.camera import Camera, rays
from share.types import F64, MAX_JPEG_BYTES, MAX_PLANE, MAX_SURFACES, MAX_UV, U8, KeyframeImage
from share.vision.image_codec import check_complete, checked_header, decode_gray, encode_jpeg, image_format

MAX_IMAGE_PIXELS = 2_400_000  # of a keyframe's image: 1920 x 1200; larger ones cost the edge too much
_JPEG_QUALITIES = (50, 25, 10)  # the first that fits; patches align as well at 50 as uncompressed


@dataclass(frozen=True, eq=False)
class Surfaces(ArrayTable):
    """The surfaces at N features of an image: see `KeyframeImage`. uv (N, 2), plane (N, 3) 1/m, rho_sigma
    (N,) 1/m."""

    uv: F64
    plane: F64
    rho_sigma: F64

    def is_valid(self) -> NDArray[np.bool_]:
        """Return which (N,) are in front of the camera and within the limits of a `KeyframeImage`."""
        rho = (rays(self.uv) * self.plane).sum(axis=1)
        in_bounds = (np.abs(self.uv) <= MAX_UV).all(axis=1) & (np.abs(self.plane) <= MAX_PLANE).all(axis=1)
        return np.asarray(in_bounds & (rho > 0) & (self.rho_sigma <= MAX_SIGMA))

    def with_image(self, image: U8 | None) -> KeyframeImage:
        """Return them with an image (H, W), compressed, or without one."""
        jpeg = np.zeros(0, np.uint8) if image is None else compress(image)
        n = len(self.uv)
        kept = np.linspace(0, n - 1, min(n, MAX_SURFACES)).astype(np.int64)  # evenly, of too many
        uv, plane, rho_sigma = (a[kept].astype(np.float32) for a in (self.uv, self.plane, self.rho_sigma))
        return KeyframeImage(jpeg, uv, plane, rho_sigma)


def compress(image: U8) -> U8:
    """Return the image (H, W) as a JPEG (B,) of at most MAX_JPEG_BYTES; empty if that is impossible, or the
    image has more than MAX_IMAGE_PIXELS."""
    if image.size > MAX_IMAGE_PIXELS:
        return np.zeros(0, np.uint8)
    for quality in _JPEG_QUALITIES:
        jpeg = encode_jpeg(image, quality, is_optimized=True)
        if len(jpeg) <= MAX_JPEG_BYTES:
            return np.frombuffer(jpeg, np.uint8)
    return np.zeros(0, np.uint8)


def with_less_quality(image: KeyframeImage, quality: int) -> KeyframeImage:
    """Return the same with its JPEG compressed again; unchanged if it is damaged, or that saves nothing."""
    if not len(image.jpeg):
        return image
    try:
        pixels = decode_gray(image.jpeg.tobytes(), "image")
    except DataError:
        return image
    jpeg = np.frombuffer(encode_jpeg(pixels, quality, is_optimized=True), np.uint8)
    return replace(image, jpeg=jpeg) if len(jpeg) < len(image.jpeg) else image


def image_objection(image: KeyframeImage, camera: Camera) -> str | None:
    """Return why the image cannot be of this camera, without decoding it; None if it can, or is empty."""
    if not len(image.jpeg):
        return None
    data = image.jpeg.tobytes()
    try:
        header = checked_header(data, "image")
        check_complete(data, "image")
    except DataError:
        return "its image is no JPEG, or cut short"
    if image_format(data) != "jpg" or header.scans > 1:
        return "its image is no baseline JPEG"
    if (header.width, header.height) != (camera.width, camera.height):
        return f"its image has {header.width}x{header.height} px, its camera {camera.width}x{camera.height}"
    if header.width * header.height > MAX_IMAGE_PIXELS:
        return f"its image has {header.width}x{header.height} px, more than {MAX_IMAGE_PIXELS}"
    return None


def decompress(image: KeyframeImage, camera: Camera) -> U8 | None:
    """Return the image (H, W) of this camera; None if there is none, or a damaged one."""
    if not len(image.jpeg) or image_objection(image, camera) is not None:
        return None
    try:
        decoded, decoder_warnings = capture_decoder_warnings(
            lambda: decode_gray(image.jpeg.tobytes(), "image")
        )
    except DataError:
        return None
    is_intact = not decoder_warnings and decoded.shape == (camera.height, camera.width)
    return decoded if is_intact else None


# ---- What a decoder writes to stderr: libjpeg fills up a damaged image and says so nowhere else. A peer
# could fill the log with such lines; and what was filled up is no image of its camera.

T = TypeVar("T")
_STDERR = 2
_redirecting = threading.Lock()  # file descriptors belong to the whole process


def capture_decoder_warnings(decode: Callable[[], T]) -> tuple[T, str]:
    """Return `decode()` and what it wrote to the process's stderr, which is not shown.

    Other threads' lines of that moment count as its own: for a process whose other threads write none."""
    with _redirecting:
        try:
            stderr = os.dup(_STDERR)
        except OSError:  # closed, so nothing can be written
            return decode(), ""
        sink = os.memfd_create("complaints")
        try:
            os.dup2(sink, _STDERR)
            try:
                result = decode()
            finally:
                os.dup2(stderr, _STDERR)
            return result, os.pread(sink, 4096, 0).decode(errors="replace")
        finally:
            os.close(stderr)
            os.close(sink)
