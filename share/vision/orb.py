"""ORB features spread over the image, with the depths of known surfaces."""

from __future__ import annotations

import cv2
import numpy as np

from share.geometry.camera import Camera, rays
from share.types import DESCRIPTOR_BYTES, F32, F64, U8, KeyframeImage, View
from share.vision.corners import GRID, UNIFORM_FIELD_DEG, field_mask, spread_order
from share.vision.depth import MIN_RHO

_SURFACE_PX = 60.0  # a feature at most this far from one of the tracker lies on that one's surface


def image_view(image: U8, camera: Camera, features: KeyframeImage, count: int) -> View:
    """Return a view of up to `count` ORB features (Rublee et al. 2011) of cam0's image (H, W).

    Each has the depth of the nearest surface of `features`, if one is near.
    """
    px, descriptors = detect_orb(image, count, field_mask(camera, UNIFORM_FIELD_DEG))
    uv = camera.normalise(px.astype(np.float64))
    points = rays(uv) / _surface_rho(px, uv, camera, features)[:, None]
    return View(uv.astype(np.float32), points.astype(np.float32), descriptors)


def _surface_rho(px: F32, uv: F64, camera: Camera, surfaces: KeyframeImage) -> F64:
    """Return the inverse depth (N,) 1/m, on the rays through px (N, 2), of the surface at the nearest
    feature; NaN without one near."""
    if len(surfaces.uv) == 0 or len(px) == 0:
        return np.full(len(px), np.nan)
    known_px = camera.distort(surfaces.uv.astype(np.float64)).astype(np.float32)
    squared_px = (px**2).sum(axis=1)[:, None] - 2 * px @ known_px.T + (known_px**2).sum(axis=1)
    nearest = squared_px.argmin(axis=1)
    rho = (rays(uv) * surfaces.plane[nearest]).sum(axis=1)
    is_near = squared_px.min(axis=1) < _SURFACE_PX**2
    out: F64 = np.where(is_near & (rho > MIN_RHO), rho, np.nan)
    return out


def detect_orb(image: U8, count: int, mask: U8 | None = None) -> tuple[F32, U8]:
    """Return up to `count` ORB keypoints (N, 2) px and descriptors (N, 32), spread over the image. mask (H,
    W): 255 where they may be.

    OpenCV's detector alone crowds them on the strongest texture, which gives poor poses.
    """
    return _describe(image, _detect(image, count, mask))


def _detect(image: U8, count: int, mask: U8 | None = None) -> list[cv2.KeyPoint]:
    """Return the `count` keypoints that are spread best over the image."""
    keypoints = _detector(3 * count).detect(image, mask)
    if not keypoints:
        return []
    px = np.asarray(cv2.KeyPoint.convert(keypoints), np.float32)
    response = np.array([k.response for k in keypoints])
    chosen = np.sort(spread_order(px, response, image.shape[::-1], GRID)[:count])
    return [keypoints[i] for i in chosen]


def _describe(image: U8, keypoints: list[cv2.KeyPoint]) -> tuple[F32, U8]:
    if not keypoints:
        return np.zeros((0, 2), np.float32), np.zeros((0, DESCRIPTOR_BYTES), np.uint8)
    kept, descriptors = _detector(len(keypoints)).compute(image, keypoints)
    px = np.asarray(cv2.KeyPoint.convert(kept), np.float32).reshape(-1, 2)
    return px, np.asarray(descriptors, np.uint8)


def _detector(max_count: int) -> cv2.ORB:
    return cv2.ORB.create(nfeatures=max_count, scaleFactor=1.2, nlevels=6, fastThreshold=10)
