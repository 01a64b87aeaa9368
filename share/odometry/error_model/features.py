"""What the last seconds were like, since the error of the last seconds is what is to be told.

A keyframe shows how well its tracker fares now; what was lost three seconds ago, in the dark, is still lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from share.odometry.error_model.history import Lately
from share.types import F32, U8, Footing, TrackState, checked
from share.vision.corners import cells

# ---- Eight numbers of a keyframe: how its image looks, and how its tracker fares.
#
# Source: SHARE, IMWUT 10(3) 97, 2026; what it leaves open is settled in docs/error-model.md.

NAMES = (
    "brightness",
    "contrast",
    "entropy",
    "laplacian variance",
    "keypoints",
    "matches",
    "active map points",
    "tracking score",
)
MANY = 200  # features or points that count as 1
_SURE_CM, _SIGMA_DECADES = 0.01, 4.0  # the tracker's own sigma: 0, and what makes 1


def scalars(small: U8, footing: Footing, sigma_cm: float) -> F32:
    """(8,) as `NAMES`, each about 0 to 1. small (240, 320): the image, scaled. sigma_cm: what the tracker
    says itself of its error (`Odometer`)."""
    believed = int(footing.believed.sum())
    mean, deviation = _moments(small)
    _, laplacian = _moments(cv2.Laplacian(small, cv2.CV_16S))
    return np.array(
        [
            mean / 255,
            deviation / 128,
            _entropy(small) / 8,
            math.log10(1 + laplacian**2) / 4,
            _many(footing.sought),
            believed / max(footing.sought, believed, 1),
            _many(footing.known),
            score(sigma_cm),
        ],
        np.float32,
    )


def _moments(image: NDArray[np.generic]) -> tuple[float, float]:
    """Mean and standard deviation."""
    mean, deviation = cv2.meanStdDev(image)
    return float(mean[0, 0]), float(deviation[0, 0])


def _entropy(image: U8) -> float:
    """Of its gray levels, bits."""
    count = cv2.calcHist([image], [0], None, [256], [0, 256])
    p = count[count > 0] / image.size
    return float(-(p * np.log2(p)).sum())


def score(sigma_cm: float) -> float:
    """The tracking score: 0 for one that is sure of itself, 1 for a metre."""
    return math.log10(max(sigma_cm, _SURE_CM) / _SURE_CM) / _SIGMA_DECADES


def _many(count: int) -> float:
    return math.log1p(count) / math.log1p(MANY)


# ---- Where in the image there is something to hold on to: the point spatial distribution (PSD).
#
# A grid over cam0's image with three channels: how strong a corner each cell has, how many features there the
# pose rests on, and how near they are. Source: SHARE, IMWUT 10(3) 97, 2026; scales: docs/error-model.md.

GRID = (16, 12)  # cells across and down, whatever the camera
CHANNELS = 3
CELL_PX = 20  # in the image in which corners are sought
_BLOCK = 3  # px, of a corner there
_WEAKEST, _CORNER_DECADES = 1e-5, 4.0  # of a corner's least eigenvalue: 0, and what makes 1
_MANY = 4  # features in a cell that count as 1
_NEAREST_M = 0.5  # counts as 1


def psd(small: U8, footing: Footing, size: tuple[int, int]) -> F32:
    """(3, 12, 16): strength of the strongest corner, features that were believed, their mean inverse depth;
    all from 0, for nothing, to 1.

    small (240, 320): the image, scaled so that a cell has `CELL_PX`; size: width and height that it had, in
    which footing is.
    """
    count = GRID[0] * GRID[1]
    px, inverse = footing.px[footing.believed], 1 / footing.depth[footing.believed]
    cell, known = cells(px, size, GRID), np.isfinite(inverse)
    believed = np.bincount(cell, minlength=count)
    total = np.bincount(cell[known], inverse[known].clip(0, 1 / _NEAREST_M), count)
    near = total / np.maximum(np.bincount(cell[known], minlength=count), 1)
    shape = (GRID[1], GRID[0])
    return np.stack(
        [
            _strength(small),
            np.minimum(believed / _MANY, 1).reshape(shape).astype(np.float32),
            (near * _NEAREST_M).reshape(shape).astype(np.float32),
        ]
    )


def _strength(small: U8) -> F32:
    """(12, 16), by the logarithm of the least eigenvalue (Shi and Tomasi 1994)."""
    least = cv2.cornerMinEigenVal(small, _BLOCK)
    best = least.reshape(GRID[1], CELL_PX, GRID[0], CELL_PX).max(axis=(1, 3))
    out: F32 = (
        (np.log10(np.maximum(best, _WEAKEST) / _WEAKEST) / _CORNER_DECADES).clip(0, 1).astype(np.float32)
    )
    return out


RECENT = (
    "mean score",
    "least score",
    "most score",
    "way",
    "turn",
    "mean surprise",
    "most surprise",
    "refused",
    "mean matches",
    "least matches",
    "weak",
    "blind",
    "deaf",
    "gap",
)
_BLIND = (TrackState.INERTIAL_ONLY, TrackState.LOST)
_FAR_M, _TURNED_RAD = 5.0, 5.0  # count as 1
_AMAZED = 100.0  # squared sigmas, the same
_GAP_S, _SHORT_S = 5.0, 0.1  # between two frames: 1, and where the logarithm begins


def recent(lately: Lately) -> F32:
    """(14,) as `RECENT`, each about 0 to 1: the tracking score (`scalars`) of the keyframes; how far the body
    went and turned; and of the frames, how surprised the tracker was, what share of the features it found it
    refused, how many it believed, in what share of them it was weak, blind (the IMU alone, or lost) and
    deaf (without an IMU), and the longest time between two."""
    scores = [score(sigma_cm) for sigma_cm in lately.sigmas_cm]
    frames = lately.frames
    stamps_ns, found, believed = (np.array([fared[k] for fared in frames]) for k in (0, 3, 4))
    surprise = np.log1p([fared.surprise for fared in frames]) / math.log1p(_AMAZED)
    refused = np.where(found > 0, np.maximum(0, 1 - believed / np.maximum(found, 1)), 0)
    matches = np.log1p(believed) / math.log1p(MANY)
    gap_s = np.diff(stamps_ns).max(initial=0) * 1e-9
    spells = [(f.state is TrackState.WEAK, f.state in _BLIND, not f.heard) for f in frames]
    return np.array(
        [
            np.mean(scores),
            min(scores),
            max(scores),
            lately.way_m / _FAR_M,
            lately.turn_rad / _TURNED_RAD,
            surprise.mean(),
            surprise.max(),
            refused.mean(),
            matches.mean(),
            matches.min(),
            *np.mean(spells, axis=0),
            math.log1p(gap_s / _SHORT_S) / math.log1p(_GAP_S / _SHORT_S),
        ],
        np.float32,
    )


# ---- What the error model is told of a keyframe: the same code makes it for training and on the agent.

PICTURE_PX = 128  # across and down: the whole image, whatever its shape
SHAPES = {
    "picture": (PICTURE_PX, PICTURE_PX),
    "psd": (CHANNELS, GRID[1], GRID[0]),
    "scalars": (len(NAMES),),
    "recent": (len(RECENT),),
}
_SMALL = (GRID[0] * CELL_PX, GRID[1] * CELL_PX)  # 320 x 240


def kind_of(name: str) -> type[np.generic]:
    """Of the numbers in this one of `SHAPES`."""
    return np.uint8 if name == "picture" else np.float32


@dataclass(frozen=True, eq=False)
class Features:
    """picture (128, 128) uint8, psd (3, 12, 16), scalars (8,) and recent (14,) float32."""

    picture: U8
    psd: F32
    scalars: F32
    recent: F32

    def __post_init__(self) -> None:
        for name, shape in SHAPES.items():
            object.__setattr__(self, name, checked(name, getattr(self, name), shape, kind_of(name)))

    def named(self) -> dict[str, NDArray[Any]]:
        return {field.name: getattr(self, field.name) for field in fields(self)}


def features(image: U8, footing: Footing, lately: Lately) -> Features:
    """Of a keyframe: its image of cam0 (H, W), what its pose stands on, and how its tracker fared of late."""
    small = _scaled(image, _SMALL)
    spread = psd(small, footing, (image.shape[1], image.shape[0]))
    return Features(_picture(small), spread, scalars(small, footing, lately.sigma_cm), recent(lately))


def picture(image: U8) -> U8:
    """That of `Features`, by itself, of an image (H, W)."""
    return _picture(_scaled(image, _SMALL))


def _picture(small: U8) -> U8:
    return _scaled(small, SHAPES["picture"])


def _scaled(image: U8, size: tuple[int, ...]) -> U8:
    """Each pixel the mean of what it covers."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
