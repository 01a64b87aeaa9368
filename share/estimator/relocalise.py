"""Finding oneself again in one's own local map, with no idea of where one is."""

from __future__ import annotations

import cv2
import numpy as np

from share.config import TrackerConfig
from share.estimator.localmap import LocalMap
from share.estimator.pose import consensus, refine
from share.geometry import se3
from share.geometry.camera import Rig
from share.types import F64, Frame
from share.vision.view import orb

MAX_HAMMING = 64  # of 256 bits
RATIO = 0.8  # Lowe's: the best match must be this much nearer than the second


def find(local_map: LocalMap, frame: Frame, rig: Rig, config: TrackerConfig, seed: int) -> F64 | None:
    """T_odom_cam (4, 4) of the frame by matching its ORB features with every keyframe, or None."""
    px, descriptors = orb(frame.image0, config.view_features)
    uv = rig.cam0.normalise(px.astype(np.float64))
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    best, best_inliers = None, 2 * config.min_inliers - 1
    for keyframe in reversed(local_map.keyframes.values()):
        view = keyframe.view
        if view is None:
            continue
        known = np.flatnonzero(~np.isnan(view.points[:, 0]))
        pairs = matcher.knnMatch(descriptors, view.descriptors[known], k=2) if len(px) else ()
        good = [m for m, *n in pairs if n and m.distance < min(MAX_HAMMING, RATIO * n[0].distance)]
        points = (
            se3.transform(
                keyframe.T_odom_cam, view.points[known[[m.trainIdx for m in good]]].astype(np.float64)
            )
            if good
            else np.zeros((0, 3))
        )
        seen = uv[[m.queryIdx for m in good]] if good else np.zeros((0, 2))
        first = consensus(points, seen, rig.cam0.focal, config.ransac_px, seed)
        if first is None or first.inliers.sum() <= best_inliers:
            continue
        sigma = np.full(len(points), config.noise_px)
        best_inliers = int(first.inliers.sum())
        best = refine(first.T, points, seen, rig.cam0.focal, sigma, config.gate_sigma).T
    return None if best is None else se3.inverse(best)
