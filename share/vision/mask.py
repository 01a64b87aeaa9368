"""What of an image is looked at: where the lens's range ends, and no more than so far off the axis."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from share.geometry.camera import Camera
from share.geometry.lens import MAX_FIELD_DEG
from share.types import U8

# For others, and for a tracker without an IMU, all points are equally good; here a pixel is four times as
# much of (x/z, y/z) as in the middle.
UNIFORM_FIELD_DEG = 60.0


@lru_cache(maxsize=8)
def field_mask(camera: Camera, max_deg: float = MAX_FIELD_DEG) -> U8 | None:
    """A mask (H, W), 255 up to so many degrees off the axis, where there are normalised coordinates; None,
    which is all, of a lens whose range does not end."""
    if not camera.is_bounded:
        return None
    px = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    uv = camera.normalise(px.astype(np.float64))
    radius = np.hypot(uv[..., 0], uv[..., 1])
    return np.where(radius < np.tan(np.radians(max_deg)), 255, 0).astype(np.uint8)
