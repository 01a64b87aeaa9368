"""Pose of a camera from matches with outliers: RANSAC over minimal solutions.

By poselib (P3P in LO-RANSAC, Larsson 2020). PyPI has no poselib for Linux on aarch64, such as a Raspberry Pi;
there OpenCV is used (USAC; Ivashechkin, Barath, Matas: USACv20, 2020): as robust, a fifth less accurate, in
five times the time. `share doctor` shows which is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from share.geometry.se3 import from_rt
from share.types import F64

try:
    import poselib
except ModuleNotFoundError:
    poselib = None

_MIN_MATCHES = 4  # three for the pose, one to choose among its solutions
_NO_POSE = np.full((4, 4), np.nan)
PoseAndInliers = tuple[F64, NDArray[np.bool_]]


@dataclass(frozen=True)
class RansacOptions:
    """Options of RANSAC.

    best_first: the matches are sorted by quality, so that a consensus is found sooner (PROSAC, Chum and
    Matas, CVPR 2005). confidence: probability that some sample had no outlier. OpenCV has no minimum of
    iterations.
    """

    threshold_px: float
    seed: int
    min_iterations: int = 20
    max_iterations: int = 1000
    best_first: bool = False
    confidence: float = 0.9999


def absolute_pose(points: F64, uv: F64, focal: float, options: RansacOptions) -> PoseAndInliers:
    """Return T_cam_world (4, 4), not finite without a solution, and the inliers (N,). Deterministic for a
    given seed.

    points: (N, 3) m, world. uv: (N, 2) normalised; focal converts them to px for the threshold.
    """
    return (by_opencv if poselib is None else by_poselib)(points, uv, focal, options)


def by_poselib(points: F64, uv: F64, focal: float, options: RansacOptions) -> PoseAndInliers:
    """Return as `absolute_pose`, by poselib."""
    camera = {"model": "SIMPLE_PINHOLE", "width": 0, "height": 0, "params": [focal, 0.0, 0.0]}
    settings = {
        "max_reproj_error": options.threshold_px,
        "seed": options.seed,
        "min_iterations": options.min_iterations,
        "max_iterations": options.max_iterations,
        "success_prob": options.confidence,
        "progressive_sampling": options.best_first,
    }
    pose, info = poselib.estimate_absolute_pose(uv * focal, points, camera, settings, {})
    return from_rt(np.asarray(pose.R), np.asarray(pose.t)), np.asarray(info["inliers"], bool)


def by_opencv(points: F64, uv: F64, focal: float, options: RansacOptions) -> PoseAndInliers:
    """Return as `absolute_pose`, by OpenCV."""
    inlier = np.zeros(len(points), bool)
    if len(points) < _MIN_MATCHES:
        return _NO_POSE, inlier
    ok, _, rvec, tvec, which = cv2.solvePnPRansac(
        np.ascontiguousarray(points)[:, None],
        np.ascontiguousarray(uv)[:, None],
        np.eye(3),
        None,
        params=_usac_params(options, focal),
    )
    if not ok or which is None:
        return _NO_POSE, inlier
    inlier[which.ravel()] = True
    return from_rt(np.asarray(cv2.Rodrigues(rvec)[0], np.float64), tvec.ravel()), inlier


def _usac_params(options: RansacOptions, focal: float) -> cv2.UsacParams:
    """Return OpenCV's parameters for normalised image coordinates."""
    params = cv2.UsacParams()
    params.threshold = options.threshold_px / focal
    params.randomGeneratorState = options.seed % 2**31
    params.maxIterations = options.max_iterations
    params.confidence = options.confidence
    params.sampler = cv2.SAMPLING_PROSAC if options.best_first else cv2.SAMPLING_UNIFORM
    params.score = cv2.SCORE_METHOD_MSAC
    params.loMethod, params.loIterations, params.loSampleSize = cv2.LOCAL_OPTIM_INNER_LO, 10, 14
    params.final_polisher, params.final_polisher_iterations = cv2.LSQ_POLISHER, 3
    params.isParallel = False
    return params
