"""A fisheye lens: up to five undistorted views, ahead and to the sides, each resampled where it is nearest.

One view of 150 degrees would be 15 times finer at its edge than in its middle, and end at 180; the faces of a
cube stay within a factor of three, and show what lies behind the camera too (Greene, Environment mapping,
1986).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import Camera
from share.lab.emulate.render.lens import MARGIN, Lens
from share.lab.emulate.render.view import pixels
from share.types import F32, F64

# Rotations (3, 3) from a face to the camera: ahead, right, left, below, above. A face looks along its z.
_FACES = [
    np.eye(3),
    np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
]


@dataclass(frozen=True, eq=False)
class Face:
    """T_cam_face (4, 4), which pixels (H, W) of the camera it shows, and how it is resampled for them."""

    T_cam_face: F64
    shown: NDArray[np.bool_]
    lens: Lens

    def axial(self) -> F32:
        """(H, W): depth along the camera's axis over depth along the face's."""
        uv = self.lens.uv.reshape(*self.shown.shape, 2)
        out: F32 = (uv @ self.T_cam_face[2, :2] + self.T_cam_face[2, 2]).astype(np.float32)
        return out


def faces(camera: Camera, zoom: float = 1.0) -> tuple[Face, ...]:
    """The faces that a fisheye camera sees; as finely drawn as `share.lab.emulate.render.lens.lens` has it.
    Pixels beyond the range of the lens belong to none."""
    px = pixels(camera).reshape(-1, 2)
    ray = camera.directions(px)
    along = np.nan_to_num(np.stack([ray @ R[:, 2] for R in _FACES]), nan=-1.0)
    nearest = np.where(np.isnan(ray[:, 0]), -1, along.argmax(axis=0))
    found = [(R, nearest == k) for k, R in enumerate(_FACES) if (nearest == k).any()]
    return tuple(_face(camera, R, shown, ray, zoom) for R, shown in found)


def _face(camera: Camera, R: F64, shown: NDArray[np.bool_], ray: F64, zoom: float) -> Face:
    here = ray[shown] @ R
    uv = here[:, :2] / here[:, 2:]
    f = camera.focal * zoom * max(1.0, _magnification(camera, R, shown))
    flat = uv * f
    low, high = np.floor(flat.min(axis=0)) - MARGIN, np.ceil(flat.max(axis=0)) + MARGIN
    width, height = (int(n) for n in high - low + 1)
    wide = Camera(width, height, f, f, float(-low[0]), float(-low[1]))
    place = np.full((len(shown), 2), MARGIN, np.float32)  # of the others: somewhere inside
    place[shown] = flat - low
    maps = place.reshape(camera.height, camera.width, 2)
    every = np.zeros((len(shown), 2))
    every[shown] = uv
    T = np.eye(4)
    T[:3, :3] = R
    optics = Lens(camera, wide, every, (maps[..., 0].copy(), maps[..., 1].copy()))
    return Face(T, shown.reshape(camera.height, camera.width), optics)


def _magnification(camera: Camera, R: F64, shown: NDArray[np.bool_]) -> float:
    """The most that the lens enlarges what the face shows, 1 being the middle of a face."""
    px, step = pixels(camera).reshape(-1, 2)[shown][::97], 1e-3
    sides = []
    for d in np.eye(2) * step:
        a, b = (camera.directions(px + s * d) @ R for s in (1, -1))
        sides.append((a[:, :2] / a[:, 2:] - b[:, :2] / b[:, 2:]) / (2 * step))
    J = np.stack(sides, axis=-1) * camera.focal
    least = np.linalg.svd(J[np.isfinite(J).all(axis=(1, 2))], compute_uv=False)[:, 1]
    return float(1 / least.min(initial=1.0))
