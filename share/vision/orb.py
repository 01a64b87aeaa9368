"""Views of keyframes: ORB features spread over the image, with their depth."""

from __future__ import annotations

import cv2
import numpy as np

from share.geometry.camera import Rig, rays
from share.types import F32, F64, U8, Frame, View
from share.vision import depth as depths
from share.vision.corners import UNIFORM_FIELD_DEG, field_mask, spread_order

_GRID = 8, 6  # cells across and down, over which features are spread
_NEIGHBOUR_PX = 4.0  # where no depth is measured, a feature this near to a known point has its depth


def measures_depth(frame: Frame, rig: Rig) -> bool:
    """Return whether stereo or a depth camera measures depth."""
    return (frame.depth is not None and rig.depth is not None) or (
        frame.image1 is not None and rig.cam1 is not None
    )


def measure_depth(frame: Frame, rig: Rig, px: F32, uv: F64, guess_m: F64 | None = None) -> F64:
    """Return the depth (N,) m in cam0 of image points, from stereo or a depth camera; NaN where unknown.
    guess_m (N,): expected depths."""
    if frame.depth is not None and rig.depth is not None:
        return depths.from_depth_camera(frame.depth, rig, uv)
    if frame.image1 is not None and rig.cam1 is not None:
        return depths.from_stereo(frame.image0, frame.image1, rig, px, uv, guess_m)
    return np.full(len(px), np.nan)


class ViewBuilder:
    """Builds a view in steps of about equal time.

    known_depths: px (M, 2) and depth (M,) m of points, used as initial depths of features near them; where
    the frame measures no depth, only features right beside them have one.
    """

    def __init__(
        self, frame: Frame, rig: Rig, count: int, known_depths: tuple[F32, F64] | None = None
    ) -> None:
        self._frame, self._rig, self._count, self._known_depths = frame, rig, count, known_depths
        self._keypoints: list[cv2.KeyPoint] | None = None
        self._features: tuple[F32, U8] | None = None
        self._measured = np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32)

    def detect(self) -> None:
        """Take the first step: keypoints."""
        mask = field_mask(self._rig.cam0, UNIFORM_FIELD_DEG)
        self._keypoints = _detect(self._frame.image0, self._count, mask)

    def describe(self) -> None:
        """Take the second step: descriptors."""
        if self._keypoints is None:
            self.detect()
        self._features = _describe(self._frame.image0, self._keypoints or [])

    def measure_half(self) -> None:
        """Take half of the third step, the depths. Call it after `describe`."""
        assert self._features is not None
        px, _ = self._features
        self._measured = self._points(px[: len(px) // 2])

    def finish(self) -> View:
        """Take the steps that are left and return the view."""
        if self._features is None:
            self.describe()
        assert self._features is not None
        px, descriptors = self._features
        uv, points = self._points(px[len(self._measured[0]) :])
        uv, points = np.concatenate([self._measured[0], uv]), np.concatenate([self._measured[1], points])
        return View(uv, points, descriptors)

    def _points(self, px: F32) -> tuple[F32, F32]:
        """Return normalised coordinates (N, 2) and points (N, 3) m of px (N, 2); NaN where depth is
        unknown."""
        rig, known = self._rig, self._known_depths
        uv = rig.cam0.normalise(px.astype(np.float64))
        if known is not None and not measures_depth(self._frame, rig):
            z = _nearest_depth(px, *known, _NEIGHBOUR_PX)
        else:
            z = measure_depth(self._frame, rig, px, uv, None if known is None else _nearest_depth(px, *known))
        return uv.astype(np.float32), (rays(uv) * z[:, None]).astype(np.float32)


def make_view(frame: Frame, rig: Rig, count: int = 500) -> View:
    """Return a view of ORB features (Rublee et al. 2011) of cam0, with 3-D points where the frame measures
    depth."""
    return ViewBuilder(frame, rig, count).finish()


def _nearest_depth(px: F32, known_px: F32, known_m: F64, within_px: float = np.inf) -> F64:
    """Return the depth (N,) m of the nearest known point; NaN where there is none within `within_px`."""
    if len(known_px) == 0:
        return np.full(len(px), np.nan)
    squared_px = (px**2).sum(axis=1)[:, None] - 2 * px @ known_px.T + (known_px**2).sum(axis=1)
    out: F64 = np.where(squared_px.min(axis=1) <= within_px**2, known_m[squared_px.argmin(axis=1)], np.nan)
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
    chosen = np.sort(spread_order(px, response, image.shape[::-1], _GRID)[:count])
    return [keypoints[i] for i in chosen]


def _describe(image: U8, keypoints: list[cv2.KeyPoint]) -> tuple[F32, U8]:
    if not keypoints:
        return np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8)
    kept, descriptors = _detector(len(keypoints)).compute(image, keypoints)
    px = np.asarray(cv2.KeyPoint.convert(kept), np.float32).reshape(-1, 2)
    return px, np.asarray(descriptors, np.uint8)


def _detector(max_count: int) -> cv2.ORB:
    return cv2.ORB.create(nfeatures=max_count, scaleFactor=1.2, nlevels=6, fastThreshold=10)
