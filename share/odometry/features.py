"""What the features of the state look like, in the order in which the state has them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.columns import Columns
from share.geometry.camera import Camera
from share.odometry.result import median
from share.types import F32, F64, I64, U8
from share.vision import patches
from share.vision.patches import Patches

_YOUNG = 10  # frames
_LATELY = 0.2  # of a residual that is added to a lag
_RUN_PX, _UNUSUAL = 0.5, 5.0  # a lag of this size, and so many times the least ones, is a motion of its own
_FEWEST_IN_COMMON = 12  # features that say something of each other
_SLANT = 0.4  # tangent of a surface's slant, one sigma of the room's surfaces
_FAR = 0.05  # 1/m; slants of what is further do not show
_NOISE = 12.0  # gray levels: more than an image's noise, because a patch repeats its own errors
_PATIENT = 0.3  # of what a frame says is taken: its errors are much like the next one's


@dataclass(frozen=True, eq=False)
class Looks(Columns):
    """patch of N features. spread (N, 2, 2): d ray / d px in the image that saw them first. slant (N, 2):
    d rho / d px there, of the surface, upright within a sigma of 1 / sqrt(upright (N,)). px (N, 2): where
    each was seen last; lag (N, 2): px by which it has lately run away from where the others say it should
    be. age (N,): frames in which it was seen."""

    patch: Patches
    spread: F64
    slant: F64
    upright: F64
    px: F32
    lag: F64
    age: I64


def looks(image: U8, camera: Camera, px: F32, ray: F64, rho: F64) -> Looks:
    """Of new features at px (N, 2) of the image, on rays (N, 2), at inverse depths (N,)."""
    n = len(px)
    spread = np.asarray(np.linalg.inv(camera.jacobian(ray)), np.float64)
    sigma = _SLANT * np.maximum(rho, _FAR) / camera.focal
    age = np.zeros(n, np.int64)
    nothing = np.zeros((n, 2))
    return Looks(patches.cut(image, px), spread, nothing, 1 / sigma**2, px, nothing.copy(), age)


def learn_slant(looks: Looks, which: I64, samples: F32, along: F64) -> None:
    """From how the patches of features `which` (M,) look where they were found: see `patches.slanted`."""
    information, step = patches.slanted(looks.patch.take(which), samples, along)
    information, step = information / _NOISE**2, step / _NOISE**2
    prior = looks.upright[which, None]
    total = information + prior[:, :, None] * np.eye(2)
    pull = step - prior * looks.slant[which]
    looks.slant[which] += _PATIENT * np.linalg.solve(total, pull[:, :, None])[:, :, 0]


def runaways(looks: Looks, which: I64, residual: F64) -> NDArray[np.bool_]:
    """Which of features `which` (M,) move on their own. residual (M, 2): px from where they were expected.

    What moves slowly passes every gate, a little off each time and always the same way, and drags the pose
    along. The quarter that lags least stands still, and what it has in common is the pose's own error.
    """
    if len(which) < _FEWEST_IN_COMMON:
        return np.zeros(len(which), bool)
    lag, quarter = looks.lag[which], len(which) // 4
    still = np.argpartition(np.hypot(lag[:, 0], lag[:, 1]), quarter)[: quarter + 1]
    own = residual - [median(axis) for axis in residual[still].T]
    looks.lag[which] = lag = lag + _LATELY * (own - lag)
    far = np.hypot(lag[:, 0], lag[:, 1])
    out: NDArray[np.bool_] = far > max(_RUN_PX, _UNUSUAL * float(np.partition(far, quarter)[quarter]))
    return out


def seen_twice(looks: Looks) -> NDArray[np.bool_]:
    """Which of these a second camera is asked for: young ones always, for their depth, others by turns."""
    out: NDArray[np.bool_] = (looks.age < _YOUNG) | (turn(looks) % 4 == 0)
    return out


def turn(looks: Looks) -> I64:
    """(N,) counts frames, each feature from another number: by it features take turns."""
    out: I64 = looks.age + np.arange(len(looks.age))
    return out


def none() -> Looks:
    pairs, one = np.zeros((0, 2)), np.zeros(0)
    return Looks(
        patches.empty(),
        np.zeros((0, 2, 2)),
        pairs,
        one,
        pairs.astype(np.float32),
        pairs,
        one.astype(np.int64),
    )
