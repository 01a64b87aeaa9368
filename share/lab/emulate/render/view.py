"""Pinhole views: projection matrix for OpenGL, frustum, shifted pixel grids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from share.geometry.camera import Camera
from share.types import F64

NEAR_M = 0.05  # near plane


def projection_matrix(camera: Camera, far: float) -> F64:
    """Return (4, 4) from the camera frame (x right, y down, z ahead, m) to clip coordinates, `NEAR_M` to
    `far` m.

    OpenGL's first row is the image's first row, and pixel centres are at integers: x = u + 1/2 there.
    """
    P = np.zeros((4, 4))
    P[0, 0], P[0, 2] = 2 * camera.fx / camera.width, 2 * (camera.cx + 0.5) / camera.width - 1
    P[1, 1], P[1, 2] = 2 * camera.fy / camera.height, 2 * (camera.cy + 0.5) / camera.height - 1
    P[2, 2], P[2, 3] = (far + NEAR_M) / (far - NEAR_M), -2 * far * NEAR_M / (far - NEAR_M)
    P[3, 2] = 1
    return P


def frustum_normals(camera: Camera) -> F64:
    """Return inward unit normals (5, 3) of the view frustum, camera frame, through the outer edges of the
    outermost pixels; the last one points ahead."""
    left, right = (-0.5 - camera.cx) / camera.fx, (camera.width - 0.5 - camera.cx) / camera.fx
    top, bottom = (-0.5 - camera.cy) / camera.fy, (camera.height - 0.5 - camera.cy) / camera.fy
    inward = np.array([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom], [0, 0, 1.0]])
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    return inward


def shifted_camera(camera: Camera, offset: F64) -> Camera:
    """Return the same view, sampled `offset` (2,) px right of and below the pixel centres."""
    return replace(camera, cx=camera.cx - float(offset[0]), cy=camera.cy - float(offset[1]))


def pixel_centres(camera: Camera) -> F64:
    """Return the pixel centres (H, W, 2)."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([columns, rows], axis=-1).astype(np.float64)
