"""Draw a panel into a recording as each camera would have seen it.

It is textured on both sides and drawn by rays through every pixel, so disparity, perspective and distortion
are the rig's. It occludes everything, nothing occludes it, and it has no motion blur. Panel coordinates: x to
its right, y down, z away from the viewer; m, its middle at 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from share.geometry import se3
from share.geometry.camera import Camera, Rig, rays
from share.types import F32, F64, U8, Frame

_PIXELS_PER_M = 400
_NOISE_SIGMA = 1.5  # gray levels
_MIN_DEPTH_M, _MAX_COORDINATE_M = 0.05, 1e4


@dataclass(frozen=True)
class Panel:
    """width, height: m. seed: of its texture."""

    width: float
    height: float
    seed: int = 0

    def texture(self) -> U8:
        """Return (H, W), gray 60 to 195: blobs of 5 mm to 10 cm."""
        rng, shape = (
            np.random.default_rng(self.seed),
            (round(self.height * _PIXELS_PER_M), round(self.width * _PIXELS_PER_M)),
        )
        total = np.zeros(shape, np.float32)
        for sigma in (2, 8, 40):
            layer = cv2.GaussianBlur(rng.standard_normal(shape, np.float32), (0, 0), sigma)
            total += layer / layer.std()
        out: U8 = np.clip(127.5 + 18 * total, 60, 195).astype(np.uint8)
        return out


def draw_panel(frames: list[Frame], rig: Rig, panel: Panel, T_body_panel: F64) -> list[Frame]:
    """Return frames with the panel at T_body_panel (N, 4, 4) before everything else; NaN: absent."""
    texture, rng = panel.texture(), np.random.default_rng(panel.seed)
    return [
        frame if np.isnan(T).any() else _draw_in_frame(frame, rig, panel, texture, T, rng)
        for frame, T in zip(frames, T_body_panel, strict=True)
    ]


def share_of_view(camera: Camera, panel: Panel, T_cam_panel: F64, step_px: int = 40) -> F64:
    """Return the panel's share (N,) of the image, for poses (N, 4, 4)."""
    rays_of = _pixel_rays(camera, step_px).reshape(-1, 3)
    xy, _, hit = _intersect_rays(rays_of, se3.inverse(T_cam_panel))
    out: F64 = (hit & _is_on_panel(panel, xy)).mean(axis=-1)
    return out


def _draw_in_frame(
    frame: Frame, rig: Rig, panel: Panel, texture: U8, T: F64, rng: np.random.Generator
) -> Frame:
    T_cam0 = se3.inverse(T) @ rig.T_body_cam0
    image1, depth = frame.image1, frame.depth
    if image1 is not None and rig.cam1 is not None and rig.T_cam1_cam0 is not None:
        image1 = _draw_in_image(image1, rig.cam1, panel, texture, T_cam0 @ se3.inverse(rig.T_cam1_cam0), rng)
    if depth is not None and rig.depth is not None and rig.T_depth_cam0 is not None:
        depth = _draw_in_depth(depth, rig.depth, panel, T_cam0 @ se3.inverse(rig.T_depth_cam0))
    image0 = _draw_in_image(frame.image0, rig.cam0, panel, texture, T_cam0, rng)
    return replace(frame, image0=image0, image1=image1, depth=depth)


def _draw_in_image(
    image: U8, camera: Camera, panel: Panel, texture: U8, T_panel_cam: F64, rng: np.random.Generator
) -> U8:
    xy, _, hit = _intersect_rays(_pixel_rays(camera), T_panel_cam)
    px = ((xy + _half_size(panel)) * _PIXELS_PER_M).astype(np.float32)
    pixels = cv2.remap(texture, px, None, cv2.INTER_LINEAR)
    noisy = pixels + _NOISE_SIGMA * rng.standard_normal(pixels.shape, np.float32)
    out: U8 = np.where(hit & _is_on_panel(panel, xy), noisy.clip(0, 255), image).astype(np.uint8)
    return out


def _draw_in_depth(depth: F32, camera: Camera, panel: Panel, T_panel_cam: F64) -> F32:
    xy, z, hit = _intersect_rays(_pixel_rays(camera), T_panel_cam)
    out: F32 = np.where(hit & _is_on_panel(panel, xy), z, depth).astype(np.float32)
    return out


def _is_on_panel(panel: Panel, xy: F64) -> np.ndarray:
    return np.asarray((np.abs(xy) < _half_size(panel)).all(axis=-1))


def _half_size(panel: Panel) -> F32:
    return np.array([panel.width / 2, panel.height / 2], np.float32)


def _intersect_rays(directions: F32, T_panel_cam: F64) -> tuple[F64, F64, np.ndarray]:
    """Intersect rays (..., 3) of a camera with the panel's plane: (x, y) on it, depth, and whether they meet
    it. With poses (N, 4, 4), results have a leading N."""
    T = T_panel_cam.astype(np.float32)
    rotated = directions @ np.swapaxes(T[..., :3, :3], -1, -2)
    start = T[..., None, :3, 3] if directions.ndim == 2 else T[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        z = -start[..., 2] / rotated[..., 2]
        xy = start[..., :2] + z[..., None] * rotated[..., :2]
    return (
        np.nan_to_num(xy).clip(-_MAX_COORDINATE_M, _MAX_COORDINATE_M),
        z,
        np.isfinite(z) & (z > _MIN_DEPTH_M),
    )


@lru_cache(maxsize=8)
def _pixel_rays(camera: Camera, step_px: int = 1) -> F32:
    """Return rays (H, W, 3) at depth 1 through every `step_px`-th pixel."""
    x, y = np.arange(0, camera.width, step_px), np.arange(0, camera.height, step_px)
    px = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)
    return rays(camera.normalise(px)).reshape(len(y), len(x), 3).astype(np.float32)
