"""A lens: one or more wide undistorted views, resampled.

For a camera with distortion, the wide view has at least the camera's pixels per radian everywhere and covers
its field of view; each pixel is then looked up where its ray meets it. A fisheye lens has up to five views,
ahead and to the sides: one of 150 degrees would be 15 times finer at its edge than in its middle, and 180
degrees is its limit, while the faces of a cube stay within a factor of three and also cover what is behind
the camera (Greene, Environment mapping, 1986).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import Camera, rays
from share.lab.emulate.render.surface import pixel_centres
from share.lab.emulate.types import I32
from share.types import F32, F64

MARGIN_PX = 2  # around the visible part, for interpolation
_MAX_WIDENING = 3.0  # times the camera's size; beyond it the model is used outside its range
_EDGE_TOLERANCE = -1e-9  # tolerance of rays outside their triangle, in sines


@dataclass(frozen=True, eq=False)
class LensResampler:
    """wide_camera: the undistorted camera to draw. uv (H W, 2): normalised coordinates of the camera's
    pixels. sample_maps: their places in the wide image, for OpenCV's remap."""

    camera: Camera
    wide_camera: Camera
    uv: F64
    sample_maps: tuple[F32, F32]

    def image(self, wide: F32) -> F32:
        """Return (H, W) through the lens, by cubic interpolation, which hardly blurs a view that is at least
        as fine as the result."""
        out: F32 = np.maximum(cv2.remap(wide, *self.sample_maps, cv2.INTER_CUBIC), 0)
        return out

    def depth(self, faces: I32, slopes: F64, corners: F64) -> F32:
        """Return the exact depth (H, W) m on the camera's rays, from the wide view's triangles (0: none).

        Of the triangles at the four pixels around a ray, take the nearest that the ray meets; if it meets
        none (a gap narrower than a pixel), that of the nearest pixel.
        """
        x, y = (m.astype(np.float64).ravel() for m in self.sample_maps)
        r = rays(self.uv)
        best = np.zeros(len(r))
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            face = faces[np.floor(y).astype(int) + dy, np.floor(x).astype(int) + dx]
            q = np.where(_ray_hits_triangle(r, corners[face]), (slopes[face] * r).sum(axis=1), 0.0)
            best = np.maximum(best, q)
        no_hit = best <= 0
        nearest = faces[np.rint(y[no_hit]).astype(int), np.rint(x[no_hit]).astype(int)]
        best[no_hit] = (slopes[nearest] * r[no_hit]).sum(axis=1)
        depth = np.divide(1, best, out=np.zeros(len(r)), where=best > 0)
        return depth.reshape(self.camera.height, self.camera.width).astype(np.float32)


def make_lens(camera: Camera, zoom: float = 1.0) -> LensResampler:
    """Return the lens of `camera`; the wide view has at least `zoom` times its pixels per radian. Raises
    ValueError if the distortion has no inverse over the image."""
    px = pixel_centres(camera).reshape(-1, 2)
    uv = camera.normalise(px)
    if not np.isfinite(uv).all() or np.abs(camera.distort(uv) - px).max() > 1e-3:
        raise ValueError("camera: its distortion has no inverse over the whole image")
    zoom *= max(1.0, _max_magnification(camera, uv))
    fx, fy = camera.fx * zoom, camera.fy * zoom
    flat = uv * (fx, fy)
    low, high = np.floor(flat.min(axis=0)) - MARGIN_PX, np.ceil(flat.max(axis=0)) + MARGIN_PX
    width, height = (int(n) for n in high - low + 1)
    if width * height > (_MAX_WIDENING * zoom) ** 2 * camera.width * camera.height:
        raise ValueError(f"camera: its distortion needs a view of {width}x{height} pixels")
    wide = Camera(width, height, fx, fy, float(-low[0]), float(-low[1]))
    place = (flat - low).astype(np.float32).reshape(camera.height, camera.width, 2)
    return LensResampler(camera, wide, uv, (place[..., 0].copy(), place[..., 1].copy()))


def _max_magnification(camera: Camera, uv: F64) -> float:
    """Return the largest magnification by the lens, relative to its centre."""
    step = 1e-5
    columns = [(camera.distort(uv + d) - camera.distort(uv - d)) / (2 * step) for d in np.eye(2) * step]
    J = np.stack(columns, axis=-1) / np.array([camera.fx, camera.fy])[:, None]
    return float(np.linalg.norm(J[::97], ord=2, axis=(1, 2)).max())


def _ray_hits_triangle(r: F64, corners: F64) -> NDArray[np.bool_]:
    """Return which rays (N, 3) pass through their triangle (N, 3, 3)."""
    sides = np.stack([_edge_side(r, corners[:, i], corners[:, (i + 1) % 3]) for i in range(3)])
    within = (sides >= _EDGE_TOLERANCE).all(axis=0) | (sides <= -_EDGE_TOLERANCE).all(axis=0)
    hits: NDArray[np.bool_] = within & (sides != 0).any(axis=0)
    return hits


def _edge_side(r: F64, a: F64, b: F64) -> F64:
    normal = np.cross(a, b)
    out: F64 = (normal * r).sum(axis=1) / np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
    return out


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
    `make_lens` would. Pixels beyond the range of the lens belong to no face."""
    px = pixel_centres(camera).reshape(-1, 2)
    ray = camera.directions(px)
    along = np.nan_to_num(np.stack([ray @ R[:, 2] for R in _FACE_ROTATIONS]), nan=-1.0)
    nearest = np.where(np.isnan(ray[:, 0]), -1, along.argmax(axis=0))
    visible = [(R, nearest == k) for k, R in enumerate(_FACE_ROTATIONS) if (nearest == k).any()]
    return tuple(_make_face(camera, R, mask, ray, zoom) for R, mask in visible)


def _make_face(camera: Camera, R: F64, mask: NDArray[np.bool_], ray: F64, zoom: float) -> FisheyeFace:
    face_rays = ray[mask] @ R
    uv = face_rays[:, :2] / face_rays[:, 2:]
    f = camera.focal * zoom * max(1.0, _max_face_magnification(camera, R, mask))
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


def _max_face_magnification(camera: Camera, R: F64, mask: NDArray[np.bool_]) -> float:
    """Return the largest magnification by the lens of the face's view, relative to the middle of a face."""
    px, step = pixel_centres(camera).reshape(-1, 2)[mask][::97], 1e-3
    sides = []
    for d in np.eye(2) * step:
        a, b = (camera.directions(px + s * d) @ R for s in (1, -1))
        sides.append((a[:, :2] / a[:, 2:] - b[:, :2] / b[:, 2:]) / (2 * step))
    J = np.stack(sides, axis=-1) * camera.focal
    smallest = np.linalg.svd(J[np.isfinite(J).all(axis=(1, 2))], compute_uv=False)[:, 1]
    return float(1 / smallest.min(initial=1.0))
