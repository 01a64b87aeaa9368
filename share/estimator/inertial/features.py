"""What the features of the state look like, in the order in which the state has them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import Camera
from share.types import F32, F64, I64, U8
from share.vision import patches
from share.vision.patches import Patches


@dataclass(frozen=True, eq=False)
class Looks:
    """patch of N features. spread (N, 2, 2): d ray / d px in the image that saw them first. px (N, 2): where
    each was seen last. age (N,): frames in which it was seen."""

    patch: Patches
    spread: F64
    px: F32
    age: I64

    def take(self, keep: NDArray[np.bool_] | I64) -> Looks:
        return Looks(self.patch.take(keep), self.spread[keep], self.px[keep], self.age[keep])

    def join(self, other: Looks) -> Looks:
        return Looks(
            self.patch.join(other.patch),
            np.concatenate([self.spread, other.spread]),
            np.concatenate([self.px, other.px]),
            np.concatenate([self.age, other.age]),
        )


def looks(image: U8, camera: Camera, px: F32, ray: F64) -> Looks:
    """Of new features at px (N, 2) of the image, on rays (N, 2)."""
    spread = np.asarray(np.linalg.inv(camera.jacobian(ray)), np.float64)
    return Looks(patches.cut(image, px), spread, px, np.zeros(len(px), np.int64))


def none() -> Looks:
    return Looks(patches.empty(), np.zeros((0, 2, 2)), np.zeros((0, 2), np.float32), np.zeros(0, np.int64))
