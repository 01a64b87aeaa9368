"""Pose of a camera from matches of which some are wrong: consensus over minimal solutions."""

from __future__ import annotations

import numpy as np
import poselib
from numpy.typing import NDArray

from share.geometry.se3 import compose
from share.types import F64


def absolute_pose(
    points: F64,
    uv: F64,
    focal: float,
    threshold_px: float,
    seed: int,
    min_iterations: int = 20,
    max_iterations: int = 1000,
    best_first: bool = False,
    confidence: float = 0.9999,
) -> tuple[F64, NDArray[np.bool_]]:
    """T_cam_world (4, 4), not finite where there is none, and the inliers (N,).

    points: (N, 3) m, world. uv: (N, 2) normalised; focal turns them into px for the threshold.
    best_first: the matches are in the order of trust, which finds a consensus sooner (PROSAC, Chum
    and Matas, CVPR 2005). confidence: that some sample had no wrong match. P3P in LO-RANSAC (poselib,
    Larsson 2020), the same for the same seed.
    """
    camera = {"model": "SIMPLE_PINHOLE", "width": 0, "height": 0, "params": [focal, 0.0, 0.0]}
    options = {
        "max_reproj_error": threshold_px,
        "seed": seed,
        "min_iterations": min_iterations,
        "max_iterations": max_iterations,
        "success_prob": confidence,
        "progressive_sampling": best_first,
    }
    pose, info = poselib.estimate_absolute_pose(uv * focal, points, camera, options, {})
    return compose(np.asarray(pose.R), np.asarray(pose.t)), np.asarray(info["inliers"], bool)
