"""The image of a keyframe from a single frame, without a tracker: depth is what the frame measures."""

from __future__ import annotations

import numpy as np

from share.geometry.camera import Rig
from share.types import Frame, KeyframeImage
from share.vision import corners
from share.vision.depth import measure_depth
from share.vision.keyframe_images import Surfaces

_SPACING_PX = 10
_RHO_SIGMA = 0.01  # 1/m, of an inverse depth


def frame_surfaces(frame: Frame, rig: Rig, count: int = 300) -> Surfaces:
    """Surfaces at up to `count` corners with a measured depth, taken to face the camera."""
    px = corners.detect(frame.image0, np.zeros((0, 2), np.float32), 4 * count, _SPACING_PX)
    uv = rig.cam0.normalise(px.astype(np.float64))
    rho = 1 / measure_depth(frame, rig, px, uv)  # NaN is not valid
    plane = np.column_stack([np.zeros((len(rho), 2)), rho])
    found = Surfaces(uv, plane, np.full(len(rho), _RHO_SIGMA))
    return found.take(np.flatnonzero(found.is_valid())[:count])


def frame_image(frame: Frame, rig: Rig, count: int = 300) -> KeyframeImage:
    """The frame's image, compressed, with its surfaces."""
    return frame_surfaces(frame, rig, count).with_image(frame.image0)
