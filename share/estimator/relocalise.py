"""Finding oneself again among keyframes one has been at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from share.config import TrackerConfig
from share.estimator.localmap import LocalKeyframe
from share.estimator.pose import PoseEstimate, consensus, refine
from share.geometry import se3
from share.geometry.camera import Rig
from share.place.matching import match
from share.types import F64, U8, Frame
from share.vision.field import EVEN_DEG, within
from share.vision.view import orb

MAX_HAMMING = 64  # of 256 bits
RATIO = 0.8  # the best match must be so much nearer than the second (Lowe 2004)


class Turns:
    """Some of the keyframes at a frame, others at the next: looking at all of them would make a live
    camera's frames late. count: at a time."""

    def __init__(self, count: int) -> None:
        self._count, self._tried = count, 0

    def begin(self) -> None:
        """Lost anew."""
        self._tried = 0

    def next(self, numbers: Sequence[int]) -> Sequence[int]:
        """Of `numbers`, the likeliest first, those whose turn it is."""
        first = self._tried % max(len(numbers), 1)
        self._tried += self._count
        return numbers[first : first + self._count]


def find(
    keyframes: Sequence[LocalKeyframe], frame: Frame, rig: Rig, config: TrackerConfig, seed: int
) -> F64 | None:
    """T_odom_cam (4, 4) of the frame by its ORB features, from the keyframe that most of them agree with.

    Twice as many inliers are asked for as tracking needs: nothing else vouches for the answer.
    """
    px, descriptors = orb(frame.image0, config.view_features, within=within(rig.cam0, EVEN_DEG))
    uv = rig.cam0.normalise(px.astype(np.float64))
    found = (_against(keyframe, uv, descriptors, rig.cam0.focal, config, seed) for keyframe in keyframes)
    best = max((f for f in found if f is not None), key=lambda f: f.inliers.sum(), default=None)
    if best is None or best.inliers.sum() < 2 * config.min_inliers:
        return None
    return se3.inverse(best.T)


def _against(
    keyframe: LocalKeyframe, uv: F64, descriptors: U8, focal: float, config: TrackerConfig, seed: int
) -> PoseEstimate | None:
    if keyframe.view is None:
        return None
    known = np.flatnonzero(~np.isnan(keyframe.view.points[:, 0]))
    pairs = match(descriptors, keyframe.view.descriptors[known], MAX_HAMMING, RATIO)
    points = keyframe.view.points[known[pairs[:, 1]]].astype(np.float64)
    points, seen = se3.transform(keyframe.T_odom_cam, points), uv[pairs[:, 0]]
    first = consensus(points, seen, focal, config.ransac_px, seed)
    if first is None:
        return None
    return refine(first.T, points, seen, focal, np.full(len(points), config.noise_px), config.gate_sigma)
