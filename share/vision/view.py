"""What a keyframe shows to other agents: ORB features spread over the image, with their depth."""

from __future__ import annotations

import cv2
import numpy as np

from share.geometry.camera import Rig, rays
from share.types import F32, F64, U8, Frame, View
from share.vision import depth as depths
from share.vision.field import EVEN_DEG, within
from share.vision.grid import evenly

_BESIDE_PX = 4.0  # of a known point, where nothing measures depth: as deep


def measures_depth(frame: Frame, rig: Rig) -> bool:
    """Whether stereo or a depth camera says how far things are."""
    return (frame.depth is not None and rig.depth is not None) or (
        frame.image1 is not None and rig.cam1 is not None
    )


def depth_at(frame: Frame, rig: Rig, px: F32, uv: F64, guess_m: F64 | None = None) -> F64:
    """Depth (N,) m in cam0 of image points, from whatever the frame carries; NaN where unknown. guess_m (N,):
    about how far they are, if that is known."""
    if frame.depth is not None and rig.depth is not None:
        return depths.from_depth_camera(frame.depth, rig, uv)
    if frame.image1 is not None and rig.cam1 is not None:
        return depths.from_stereo(frame.image0, frame.image1, rig, px, uv, guess_m)
    return np.full(len(px), np.nan)


def make_view(frame: Frame, rig: Rig, count: int = 500, known: tuple[F32, F64] | None = None) -> View:
    """ORB features (Rublee et al. 2011) of cam0 with 3D points where the frame gives depth. known: px (M, 2)
    and depth (M,) m of points whose neighbours will not be much nearer or further; where the frame measures
    nothing, only what is right beside them has a depth."""
    px, descriptors = orb(frame.image0, count, within=within(rig.cam0, EVEN_DEG))
    uv = rig.cam0.normalise(px.astype(np.float64))
    if known is not None and not measures_depth(frame, rig):
        z = _nearest(px, *known, _BESIDE_PX)
    else:
        z = depth_at(frame, rig, px, uv, None if known is None else _nearest(px, *known))
    points = rays(uv) * z[:, None]
    return View(uv.astype(np.float32), points.astype(np.float32), descriptors)


def _nearest(px: F32, known_px: F32, known_m: F64, within_px: float = np.inf) -> F64:
    """Depth (N,) m of the known point next to each; NaN where there is none within so many px."""
    if len(known_px) == 0:
        return np.full(len(px), np.nan)
    apart = (px**2).sum(axis=1)[:, None] - 2 * px @ known_px.T + (known_px**2).sum(axis=1)
    out: F64 = np.where(apart.min(axis=1) <= within_px**2, known_m[apart.argmin(axis=1)], np.nan)
    return out


def orb(image: U8, count: int, grid: tuple[int, int] = (8, 6), within: U8 | None = None) -> tuple[F32, U8]:
    """Up to `count` ORB keypoints (N, 2) px and descriptors (N, 32), strongest first in each cell. within
    (H, W): a mask of where to look.

    OpenCV's detector alone crowds them on the strongest texture; pose from a crowd is weak.
    """
    detector = cv2.ORB.create(nfeatures=3 * count, scaleFactor=1.2, nlevels=6, fastThreshold=10)
    keypoints = detector.detect(image, within)
    if not keypoints:
        return np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8)
    px = np.asarray(cv2.KeyPoint.convert(keypoints), np.float32)
    response = np.array([k.response for k in keypoints])
    chosen = np.sort(evenly(px, response, image.shape[::-1], grid)[:count])
    kept, descriptors = detector.compute(image, [keypoints[i] for i in chosen])
    px = np.asarray(cv2.KeyPoint.convert(kept), np.float32).reshape(-1, 2)
    return px, np.asarray(descriptors, np.uint8)
