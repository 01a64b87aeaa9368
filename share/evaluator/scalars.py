"""Eight numbers of a keyframe: how its image looks, and how its tracker fares.

Source: SHARE, IMWUT 10(3) 97, 2026; what it leaves open is settled in docs/error-model.md.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from share.types import F32, U8, Footing

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
_SURE_CM, _DECADES = 0.01, 4.0  # the tracker's own sigma: 0, and what makes 1


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
    return math.log10(max(sigma_cm, _SURE_CM) / _SURE_CM) / _DECADES


def _many(count: int) -> float:
    return math.log1p(count) / math.log1p(MANY)
