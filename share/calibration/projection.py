"""Projection of a target's corners by a lens, and all its derivatives.

Models and order of the coefficients as in `share.geometry.lens`: fx fy cx cy, then k1 k2 p1 p2 [k3] of
radtan, k1 k2 k3 k4 of equidistant.
"""

from __future__ import annotations

import numpy as np

from share.geometry.camera import Camera
from share.geometry.lens import EQUIDISTANT, lens
from share.geometry.se3 import hat
from share.types import F64

_RADTAN, _EQUIDISTANT = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")


def names(camera: Camera) -> tuple[str, ...]:
    """Of its parameters, in order: as many as are sought with it."""
    coefficients = _EQUIDISTANT if camera.model == EQUIDISTANT else _RADTAN
    return "fx", "fy", "cx", "cy", *coefficients[: max(len(camera.distortion), 4)]


def intrinsics(camera: Camera) -> F64:
    """(I,): those of `names`."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *(camera.distortion or (0.0,) * 4)])


def camera_of(theta: F64, like: Camera) -> Camera:
    """The camera of `theta` (I,) with the images and the model of another. Raises ValueError."""
    fx, fy, cx, cy, *distortion = (float(value) for value in theta)
    return Camera(like.width, like.height, fx, fy, cx, cy, tuple(distortion), like.model)


def project(camera: Camera, points: F64) -> tuple[F64, F64, F64]:
    """Points (N, 3) in the camera frame -> px (N, 2), d px / d intrinsics (N, 2, I) and d px / d points
    (N, 2, 3). What is out of the lens's range gives NaN: behind the camera, unless it is a fisheye."""
    bends = lens(camera.model, camera.distortion or (0.0,) * 4)
    if not camera.fisheye:
        points = np.where(points[:, 2:] > 1e-6, points, np.nan)
    bent, scale = bends.bend_points(points), np.array([camera.fx, camera.fy])
    by = np.zeros((len(points), 2, len(names(camera))))
    by[:, 0, 0], by[:, 1, 1] = bent.T
    by[:, 0, 2] = by[:, 1, 3] = 1
    by[:, :, 4:] = bends.by_coefficients(points) * scale[:, None]
    return bent * scale + (camera.cx, camera.cy), by, bends.jacobian_points(points) * scale[:, None]


def moved(T: F64, points: F64) -> tuple[F64, F64]:
    """T_a_b (..., 4, 4), points (..., 3) in b -> those in a, and their derivatives (..., 3, 6) by xi of
    T Exp(xi)."""
    R = T[..., :3, :3]
    at = (R @ points[..., None])[..., 0] + T[..., :3, 3]
    return at, np.concatenate([-R @ hat(points), np.broadcast_to(R, (*points.shape, 3))], axis=-1)
