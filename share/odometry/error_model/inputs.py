"""Inputs of the error model, made by the same code for training and on the agent.

Source: SHARE, IMWUT 10(3) 97, 2026; scales and what it leaves open: docs/understand/error-model.md. Besides
the paper's
inputs there is the tracking of the last seconds, because the error of the last seconds is estimated: a
keyframe shows how well its tracker works now, not what it lost in the dark three seconds ago.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from share.checks import checked_array
from share.odometry.error_model.history import RecentMotion
from share.types import F32, U8, FeatureStatistics, TrackState
from share.vision.corners import cell_indices

# Scalars of a keyframe: of its image and of its tracking.

SCALAR_NAMES = (
    "brightness",
    "contrast",
    "entropy",
    "laplacian variance",
    "keypoints",
    "matches",
    "active map points",
    "tracking score",
)
COUNT_SCALE = 200  # features or points, for a value of 1
_MIN_SIGMA_CM, _SIGMA_DECADES = 0.01, 4.0  # the filter's sigma for a value of 0, and the decades from 0 to 1


def scalar_features(thumbnail: U8, statistics: FeatureStatistics, sigma_cm: float) -> F32:
    """Return the scalars (8,) named in `SCALAR_NAMES`, each about 0 to 1.

    thumbnail (240, 320): the image, scaled. sigma_cm: the filter's sigma of its error (`RecentMotion`).
    """
    inlier_count = int(statistics.inlier.sum())
    mean, deviation = _moments(thumbnail)
    _, laplacian = _moments(cv2.Laplacian(thumbnail, cv2.CV_16S))
    return np.array(
        [
            mean / 255,
            deviation / 128,
            _entropy(thumbnail) / 8,
            math.log10(1 + laplacian**2) / 4,
            _log_count(statistics.expected),
            inlier_count / max(statistics.expected, inlier_count, 1),
            _log_count(statistics.mapped),
            tracking_score(sigma_cm),
        ],
        np.float32,
    )


def _moments(image: NDArray[np.generic]) -> tuple[float, float]:
    """Return mean and standard deviation."""
    mean, deviation = cv2.meanStdDev(image)
    return float(mean[0, 0]), float(deviation[0, 0])


def _entropy(image: U8) -> float:
    """Return the entropy of its gray levels, bits."""
    count = cv2.calcHist([image], [0], None, [256], [0, 256])
    p = count[count > 0] / image.size
    return float(-(p * np.log2(p)).sum())


def tracking_score(sigma_cm: float) -> float:
    """Return the tracking score: 0 for a sigma of 0.1 mm, 1 for 1 m, logarithmic."""
    return math.log10(max(sigma_cm, _MIN_SIGMA_CM) / _MIN_SIGMA_CM) / _SIGMA_DECADES


def sigma_of_score(score: float) -> float:
    """Return the sigma of a tracking score, cm."""
    return float(_MIN_SIGMA_CM * 10.0 ** (_SIGMA_DECADES * score))


def _log_count(count: int) -> float:
    return math.log1p(count) / math.log1p(COUNT_SCALE)


# The point spatial distribution (PSD): a grid over cam0's image.

PSD_GRID = (16, 12)  # cells across and down, whatever the camera
PSD_CHANNELS = 3
CELL_PX = 20  # of the thumbnail
_CORNER_BLOCK_PX = 3
_MIN_EIGENVALUE, _CORNER_DECADES = 1e-5, 4.0  # least eigenvalue for a value of 0, and the decades from 0 to 1
_FEATURES_PER_CELL = 4  # for a value of 1
_MIN_DEPTH_M = 0.5  # for a value of 1


def point_distribution(thumbnail: U8, statistics: FeatureStatistics, size: tuple[int, int]) -> F32:
    """Return the PSD (3, 12, 16): strength of the strongest corner, number of inliers, their mean inverse
    depth, each 0 to 1.

    thumbnail (240, 320): the image, scaled so that a cell has `CELL_PX`. size: width and height of the image
    itself, in which `statistics` has its px.
    """
    count = PSD_GRID[0] * PSD_GRID[1]
    px, inverse = statistics.px[statistics.inlier], 1 / statistics.depth[statistics.inlier]
    cell, is_known = cell_indices(px, size, PSD_GRID), np.isfinite(inverse)
    inlier_count = np.bincount(cell, minlength=count)
    total = np.bincount(cell[is_known], inverse[is_known].clip(0, 1 / _MIN_DEPTH_M), count)
    mean_inverse = total / np.maximum(np.bincount(cell[is_known], minlength=count), 1)
    shape = (PSD_GRID[1], PSD_GRID[0])
    return np.stack(
        [
            _corner_strength(thumbnail),
            np.minimum(inlier_count / _FEATURES_PER_CELL, 1).reshape(shape).astype(np.float32),
            (mean_inverse * _MIN_DEPTH_M).reshape(shape).astype(np.float32),
        ]
    )


def _corner_strength(thumbnail: U8) -> F32:
    """Return (12, 16), by the logarithm of the least eigenvalue (Shi and Tomasi 1994)."""
    eigenvalue = cv2.cornerMinEigenVal(thumbnail, _CORNER_BLOCK_PX)
    strongest = eigenvalue.reshape(PSD_GRID[1], CELL_PX, PSD_GRID[0], CELL_PX).max(axis=(1, 3))
    out: F32 = (
        (np.log10(np.maximum(strongest, _MIN_EIGENVALUE) / _MIN_EIGENVALUE) / _CORNER_DECADES)
        .clip(0, 1)
        .astype(np.float32)
    )
    return out


# The tracking of the last seconds.

RECENT_NAMES = (
    "mean score",
    "minimum score",
    "maximum score",
    "path",
    "rotation",
    "mean NIS",
    "maximum NIS",
    "rejected",
    "mean matches",
    "minimum matches",
    "weak",
    "blind",
    "no IMU",
    "gap",
)
_BLIND_STATES = (TrackState.INERTIAL_ONLY, TrackState.LOST)
_PATH_SCALE_M, _ROTATION_SCALE_RAD = 5.0, 5.0  # for a value of 1
_NIS_SCALE = 100.0  # squared sigmas, for a value of 1
_GAP_SCALE_S, _MIN_GAP_S = 5.0, 0.1  # for a value of 1, and the scale of the logarithm


def recent_features(motion: RecentMotion) -> F32:
    """Return the features (14,) named in `RECENT_NAMES`, each about 0 to 1.

    Of keyframes: the tracking score (`scalar_features`), path and rotation. Of frames: the median NIS, the
    share of features rejected, the number of inliers, the shares of frames that were weak, blind (IMU only,
    or LOST) and without IMU, and the longest time between two frames.
    """
    scores = [tracking_score(sigma_cm) for sigma_cm in motion.sigmas_cm]
    frames = motion.frames
    stamps_ns, found_count, inlier_count = (np.array([outcome[k] for outcome in frames]) for k in (0, 3, 4))
    log_nis = np.log1p([outcome.median_nis for outcome in frames]) / math.log1p(_NIS_SCALE)
    rejected = np.where(found_count > 0, np.maximum(0, 1 - inlier_count / np.maximum(found_count, 1)), 0)
    matches = np.log1p(inlier_count) / math.log1p(COUNT_SCALE)
    gap_s = np.diff(stamps_ns).max(initial=0) * 1e-9
    flags = [(f.state is TrackState.WEAK, f.state in _BLIND_STATES, not f.has_imu) for f in frames]
    return np.array(
        [
            np.mean(scores),
            min(scores),
            max(scores),
            motion.path_m / _PATH_SCALE_M,
            motion.rotation_rad / _ROTATION_SCALE_RAD,
            log_nis.mean(),
            log_nis.max(),
            rejected.mean(),
            matches.mean(),
            matches.min(),
            *np.mean(flags, axis=0),
            math.log1p(gap_s / _MIN_GAP_S) / math.log1p(_GAP_SCALE_S / _MIN_GAP_S),
        ],
        np.float32,
    )


# The complete input.

PICTURE_PX = 128  # across and down: the whole image, whatever its shape
INPUT_SHAPES = {
    "picture": (PICTURE_PX, PICTURE_PX),
    "psd": (PSD_CHANNELS, PSD_GRID[1], PSD_GRID[0]),
    "scalars": (len(SCALAR_NAMES),),
    "recent": (len(RECENT_NAMES),),
}
_THUMBNAIL_SIZE = (PSD_GRID[0] * CELL_PX, PSD_GRID[1] * CELL_PX)  # 320 x 240


def input_dtype(name: str) -> type[np.generic]:
    """Return the data type of this entry of `INPUT_SHAPES`."""
    return np.uint8 if name == "picture" else np.float32


@dataclass(frozen=True, eq=False)
class ErrorModelInput:
    """picture (128, 128) uint8, psd (3, 12, 16), scalars (8,) and recent (14,) float32."""

    picture: U8
    psd: F32
    scalars: F32
    recent: F32

    def __post_init__(self) -> None:
        for name, shape in INPUT_SHAPES.items():
            object.__setattr__(self, name, checked_array(name, getattr(self, name), shape, input_dtype(name)))

    def arrays_by_name(self) -> dict[str, NDArray[Any]]:
        return {field.name: getattr(self, field.name) for field in fields(self)}


def error_model_input(image: U8, statistics: FeatureStatistics, motion: RecentMotion) -> ErrorModelInput:
    """Return the input for a keyframe: image of cam0 (H, W), its feature statistics and the recent motion."""
    thumbnail = _resized(image, _THUMBNAIL_SIZE)
    distribution = point_distribution(thumbnail, statistics, (image.shape[1], image.shape[0]))
    return ErrorModelInput(
        _resized(thumbnail, INPUT_SHAPES["picture"]),
        distribution,
        scalar_features(thumbnail, statistics, motion.sigma_cm),
        recent_features(motion),
    )


def _resized(image: U8, size: tuple[int, ...]) -> U8:
    """Return the image resized by averaging the area of each pixel."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
