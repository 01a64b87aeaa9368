"""Masks of the part of an image that is used: within the range of the lens, and within an angle from its
axis."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from share.geometry.camera import Camera
from share.geometry.lens import MAX_FIELD_DEG
from share.types import U8

# Limit for views and for a tracker without an IMU, which weigh all points alike: here a pixel is four times
# as large in (x/z, y/z) as on the axis.
UNIFORM_FIELD_DEG = 60.0


@lru_cache(maxsize=8)
def field_mask(camera: Camera, max_deg: float = MAX_FIELD_DEG) -> U8 | None:
    """Return a mask (H, W), 255 within `max_deg` of the axis and the range of the lens; None, for all, of
    an unbounded lens."""
    if not camera.is_bounded:
        return None
    px = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    uv = camera.normalise(px.astype(np.float64))
    radius = np.hypot(uv[..., 0], uv[..., 1])
    return np.where(radius < np.tan(np.radians(max_deg)), 255, 0).astype(np.uint8)
