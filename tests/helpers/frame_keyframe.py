"""Keyframes of single frames, without a tracker: depth is what the frame measures."""

from __future__ import annotations

import numpy as np

from share.geometry.camera import Rig, rays
from share.types import Frame, KeyframeImage, View
from share.vision import corners
from share.vision.corners import UNIFORM_FIELD_DEG, field_mask
from share.vision.keyframe_images import Surfaces
from share.vision.orb import detect_orb, measure_depth

_SPACING_PX = 15
_RHO_SIGMA = 0.01  # 1/m, of an inverse depth


def frame_view(frame: Frame, rig: Rig, count: int = 500) -> View:
    """ORB features of cam0, each with the depth that the frame measures there."""
    px, descriptors = detect_orb(frame.image0, count, field_mask(rig.cam0, UNIFORM_FIELD_DEG))
    uv = rig.cam0.normalise(px.astype(np.float64))
    points = rays(uv) * measure_depth(frame, rig, px, uv)[:, None]
    return View(uv.astype(np.float32), points.astype(np.float32), descriptors)


def frame_surfaces(frame: Frame, rig: Rig, count: int = 300) -> Surfaces:
    """Surfaces at corners with a measured depth, taken to face the camera."""
    px = corners.detect(frame.image0, np.zeros((0, 2), np.float32), count, _SPACING_PX)
    uv = rig.cam0.normalise(px.astype(np.float64))
    rho = 1 / measure_depth(frame, rig, px, uv)  # NaN is not valid
    plane = np.column_stack([np.zeros((len(rho), 2)), rho])
    found = Surfaces(uv, plane, np.full(len(rho), _RHO_SIGMA))
    return found.take(found.is_valid())


def frame_image(frame: Frame, rig: Rig, count: int = 300) -> KeyframeImage:
    """The frame's image, compressed, with its surfaces."""
    return frame_surfaces(frame, rig, count).with_image(frame.image0)
