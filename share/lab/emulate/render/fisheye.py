"""A fisheye lens: up to five undistorted views, ahead and to the sides, each resampled where it is nearest.

One view of 150 degrees would be 15 times finer at its edge than in its middle, and 180 degrees is its limit;
the faces of a cube stay within a factor of three and also cover what is behind the camera (Greene,
Environment mapping, 1986).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import Camera
from share.lab.emulate.render.lens import MARGIN_PX, LensResampler
from share.lab.emulate.render.view import pixel_centres
from share.types import F32, F64

# Rotations (3, 3) from a face to the camera: ahead, right, left, below, above. A face looks along its z.
_FACE_ROTATIONS = [
    np.eye(3),
    np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
]


@dataclass(frozen=True, eq=False)
class FisheyeFace:
    """One face. T_cam_face (4, 4); pixel_mask (H, W): pixels of the camera that it covers; lens: its
    resampling."""

    T_cam_face: F64
    pixel_mask: NDArray[np.bool_]
    lens: LensResampler

    def axis_depth_ratio(self) -> F32:
        """Return (H, W): depth along the camera's axis over depth along the face's."""
        uv = self.lens.uv.reshape(*self.pixel_mask.shape, 2)
        out: F32 = (uv @ self.T_cam_face[2, :2] + self.T_cam_face[2, 2]).astype(np.float32)
        return out


def fisheye_faces(camera: Camera, zoom: float = 1.0) -> tuple[FisheyeFace, ...]:
    """Return the faces that a fisheye camera sees, drawn as finely as
    `share.lab.emulate.render.lens.make_lens` would. Pixels beyond the range of the lens belong to no face."""
    px = pixel_centres(camera).reshape(-1, 2)
    ray = camera.directions(px)
    along = np.nan_to_num(np.stack([ray @ R[:, 2] for R in _FACE_ROTATIONS]), nan=-1.0)
    nearest = np.where(np.isnan(ray[:, 0]), -1, along.argmax(axis=0))
    visible = [(R, nearest == k) for k, R in enumerate(_FACE_ROTATIONS) if (nearest == k).any()]
    return tuple(_make_face(camera, R, mask, ray, zoom) for R, mask in visible)


def _make_face(camera: Camera, R: F64, mask: NDArray[np.bool_], ray: F64, zoom: float) -> FisheyeFace:
    face_rays = ray[mask] @ R
    uv = face_rays[:, :2] / face_rays[:, 2:]
    f = camera.focal * zoom * max(1.0, _max_magnification(camera, R, mask))
    flat = uv * f
    low, high = np.floor(flat.min(axis=0)) - MARGIN_PX, np.ceil(flat.max(axis=0)) + MARGIN_PX
    width, height = (int(n) for n in high - low + 1)
    wide = Camera(width, height, f, f, float(-low[0]), float(-low[1]))
    place = np.full((len(mask), 2), MARGIN_PX, np.float32)  # for other pixels any place inside
    place[mask] = flat - low
    maps = place.reshape(camera.height, camera.width, 2)
    all_uv = np.zeros((len(mask), 2))
    all_uv[mask] = uv
    T = np.eye(4)
    T[:3, :3] = R
    optics = LensResampler(camera, wide, all_uv, (maps[..., 0].copy(), maps[..., 1].copy()))
    return FisheyeFace(T, mask.reshape(camera.height, camera.width), optics)


def _max_magnification(camera: Camera, R: F64, mask: NDArray[np.bool_]) -> float:
    """Return the largest magnification by the lens of the face's view, relative to the middle of a face."""
    px, step = pixel_centres(camera).reshape(-1, 2)[mask][::97], 1e-3
    sides = []
    for d in np.eye(2) * step:
        a, b = (camera.directions(px + s * d) @ R for s in (1, -1))
        sides.append((a[:, :2] / a[:, 2:] - b[:, :2] / b[:, 2:]) / (2 * step))
    J = np.stack(sides, axis=-1) * camera.focal
    smallest = np.linalg.svd(J[np.isfinite(J).all(axis=(1, 2))], compute_uv=False)[:, 1]
    return float(1 / smallest.min(initial=1.0))
