"""Projection of a target's corners with radial-tangential distortion, and all its derivatives.

Model and order of the coefficients as in `share.geometry.camera`: fx fy cx cy k1 k2 p1 p2.
"""

from __future__ import annotations

import numpy as np

from share.geometry.camera import Camera
from share.geometry.se3 import hat
from share.types import F64

INTRINSICS = 8


def intrinsics(camera: Camera) -> F64:
    """(8,): fx fy cx cy k1 k2 p1 p2."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *(camera.distortion or (0.0,) * 4)[:4]])


def camera_of(theta: F64, size: tuple[int, int]) -> Camera:
    """The camera of `theta` (8,) with images of size (width, height). Raises ValueError."""
    fx, fy, cx, cy, *distortion = (float(value) for value in theta)
    return Camera(*size, fx, fy, cx, cy, tuple(distortion))


def project(camera: Camera, points: F64) -> tuple[F64, F64, F64]:
    """Points (N, 3) in the camera frame -> px (N, 2), d px / d intrinsics (N, 2, 8) and d px / d points
    (N, 2, 3). Points behind the camera give NaN."""
    z = np.where(points[:, 2] > 1e-6, points[:, 2], np.nan)
    uv = points[:, :2] / z[:, None]
    px = camera.distort(uv)
    into = np.zeros((len(points), 2, 3))
    into[:, 0, 0] = into[:, 1, 1] = 1 / z
    into[:, :, 2] = -uv / z[:, None]
    return px, _by_intrinsics(camera, px, uv), camera.jacobian(uv) @ into


def _by_intrinsics(camera: Camera, px: F64, uv: F64) -> F64:
    x, y = uv.T
    r2 = x * x + y * y
    out = np.zeros((len(uv), 2, INTRINSICS))
    out[:, 0, 0] = (px[:, 0] - camera.cx) / camera.fx
    out[:, 1, 1] = (px[:, 1] - camera.cy) / camera.fy
    out[:, 0, 2] = out[:, 1, 3] = 1
    bent = np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x], axis=1)
    out[:, 0, 4:] = camera.fx * bent
    bent = np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y], axis=1)
    out[:, 1, 4:] = camera.fy * bent
    return out


def moved(T: F64, points: F64) -> tuple[F64, F64]:
    """T_a_b (..., 4, 4), points (..., 3) in b -> those in a, and their derivatives (..., 3, 6) by xi of
    T Exp(xi)."""
    R = T[..., :3, :3]
    at = (R @ points[..., None])[..., 0] + T[..., :3, 3]
    return at, np.concatenate([-R @ hat(points), np.broadcast_to(R, (*points.shape, 3))], axis=-1)
