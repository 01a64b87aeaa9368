"""What the error model is told of a keyframe: the same code makes it for training and on the agent."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from share.evaluator.odometer import Lately
from share.evaluator.psd import CELL_PX, CHANNELS, GRID, psd
from share.evaluator.recent import RECENT, recent
from share.evaluator.scalars import NAMES, scalars
from share.types import F32, U8, Footing, checked

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
