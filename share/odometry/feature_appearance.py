"""Appearance of the state's features, in the order of the state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.array_table import ArrayTable
from share.geometry.camera import Camera
from share.odometry.track_result import median
from share.types import F32, F64, I64, U8
from share.vision import patches
from share.vision.patches import Patches

_YOUNG_FRAMES = 10  # a feature of fewer frames is matched in cam1 in every frame
_DRIFT_GAIN = 0.2  # of the exponential mean of a feature's residual
# A feature moves by itself if its drift is above this, and above this many times the first quartile of all.
_MIN_DRIFT_PX, _MIN_DRIFT_RATIO = 0.5, 5.0
_MIN_FEATURES = 12  # fewer cannot be compared with each other
_SLANT_SIGMA = 0.4  # tangent of a surface's slant, one sigma of the room's surfaces
_MIN_RHO = 0.05  # 1/m; the slant of what is further away does not show
_GRAY_NOISE = 12.0  # gray levels: more than an image's noise, because a patch repeats its errors
_SLANT_GAIN = 0.3  # part of a frame's correction that is applied: errors of successive frames correlate


@dataclass(frozen=True, eq=False)
class Appearance(ArrayTable):
    """Appearance of N features.

    patch: from the image in which each was first seen. ray_per_px (N, 2, 2): d ray / d px in that image.
    slant (N, 2): d rho / d px there, of the surface, with slant_information (N,), the inverse variance of a
    prior of 0. last_px (N, 2): the last position in an image. drift_px (N, 2): exponential mean of its
    residual relative to static features. age (N,): frames in which it was seen.
    """

    patch: Patches
    ray_per_px: F64
    slant: F64
    slant_information: F64
    last_px: F32
    drift_px: F64
    age: I64


def extract_appearance(image: U8, camera: Camera, px: F32, ray: F64, rho: F64) -> Appearance:
    """Return the appearance of new features at px (N, 2) of the image, on rays (N, 2), at inverse depths (N,)
    1/m."""
    n = len(px)
    ray_per_px = np.asarray(np.linalg.inv(camera.jacobian(ray)), np.float64)
    sigma = _SLANT_SIGMA * np.maximum(rho, _MIN_RHO) / camera.focal
    age = np.zeros(n, np.int64)
    zeros = np.zeros((n, 2))
    return Appearance(patches.extract(image, px), ray_per_px, zeros, 1 / sigma**2, px, zeros.copy(), age)


def update_slant(appearance: Appearance, indices: I64, samples: F32, px_per_rho: F64) -> None:
    """Update the slant of features `indices` (M,) in place from the samples at which they were matched: see
    `patches.slant_evidence`."""
    information, step = patches.slant_evidence(appearance.patch.take(indices), samples, px_per_rho)
    information, step = information / _GRAY_NOISE**2, step / _GRAY_NOISE**2
    prior = appearance.slant_information[indices, None]
    total = information + prior[:, :, None] * np.eye(2)
    pull = step - prior * appearance.slant[indices]
    appearance.slant[indices] += _SLANT_GAIN * np.linalg.solve(total, pull[:, :, None])[:, :, 0]


def drifting_features(appearance: Appearance, indices: I64, residual: F64) -> NDArray[np.bool_]:
    """Return which of features `indices` (M,) move by themselves, and update their drift. residual (M, 2):
    px, measured minus predicted.

    A slowly moving feature passes every gate, since it is only a little off each time, but always in the same
    direction, so that it biases the pose. The quarter with the least drift counts as static; its median
    residual is the pose's error.
    """
    if len(indices) < _MIN_FEATURES:
        return np.zeros(len(indices), bool)
    drift, quarter = appearance.drift_px[indices], len(indices) // 4
    still = np.argpartition(np.hypot(drift[:, 0], drift[:, 1]), quarter)[: quarter + 1]
    relative = residual - [median(axis) for axis in residual[still].T]
    appearance.drift_px[indices] = drift = drift + _DRIFT_GAIN * (relative - drift)
    speed = np.hypot(drift[:, 0], drift[:, 1])
    out: NDArray[np.bool_] = speed > max(
        _MIN_DRIFT_PX, _MIN_DRIFT_RATIO * float(np.partition(speed, quarter)[quarter])
    )
    return out


def is_stereo_due(appearance: Appearance) -> NDArray[np.bool_]:
    """Return which features (N,) to match in cam1: young ones in every frame, for their depth, others in
    every fourth."""
    out: NDArray[np.bool_] = (appearance.age < _YOUNG_FRAMES) | (staggered_age(appearance) % 4 == 0)
    return out


def staggered_age(appearance: Appearance) -> I64:
    """Return frame counts (N,) with another offset for each feature, by which features take turns."""
    out: I64 = appearance.age + np.arange(len(appearance.age))
    return out


def empty_appearance() -> Appearance:
    pairs, one = np.zeros((0, 2)), np.zeros(0)
    return Appearance(
        patches.empty_patches(),
        np.zeros((0, 2, 2)),
        pairs,
        one,
        pairs.astype(np.float32),
        pairs,
        one.astype(np.int64),
    )
