"""What the error model is told of a keyframe: the same code makes it for training and on the agent."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from share.evaluator.psd import CELL_PX, CHANNELS, GRID, psd
from share.evaluator.scalars import NAMES, scalars
from share.types import F32, U8, Footing, checked

PICTURE_PX = 128  # across and down: the whole image, whatever its shape
_SMALL = (GRID[0] * CELL_PX, GRID[1] * CELL_PX)  # 320 x 240


@dataclass(frozen=True, eq=False)
class Features:
    """picture (128, 128) uint8, psd (3, 12, 16) and scalars (8,) float32."""

    picture: U8
    psd: F32
    scalars: F32

    def __post_init__(self) -> None:
        for name, shape, kind in (
            ("picture", (PICTURE_PX, PICTURE_PX), np.uint8),
            ("psd", (CHANNELS, GRID[1], GRID[0]), np.float32),
            ("scalars", (len(NAMES),), np.float32),
        ):
            object.__setattr__(self, name, checked(name, getattr(self, name), shape, kind))


def features(image: U8, footing: Footing, sigma_cm: float) -> Features:
    """Of a keyframe: its image of cam0 (H, W), what its pose stands on, and what `Doubt` says of it."""
    small = _scaled(image, _SMALL)
    spread = psd(small, footing, (image.shape[1], image.shape[0]))
    return Features(_scaled(small, (PICTURE_PX, PICTURE_PX)), spread, scalars(small, footing, sigma_cm))


def _scaled(image: U8, size: tuple[int, int]) -> U8:
    """Each pixel the mean of what it covers."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
