"""A large upright panel that moves while a camera looks at it: its path, and how each camera sees it.

It is textured on both sides and drawn by rays through every pixel, so disparity, perspective and distortion
are the rig's. It occludes everything, nothing occludes it, and it has no motion blur. Panel coordinates: x to
its right, y down, z away from the viewer; m, its middle at 0.
"""

from __future__ import annotations

from collections.abc import Iterator
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


_ENTER_S = 1.5
_SWAY_S = 4.0  # period
_DISTANCE_M, _START_ASIDE_M, _SWAY_M = 1.0, 1.7, 0.3
_TARGET_VIEW_SHARE, _MAX_VIEW_SHARE = 0.4, 0.6  # share of the view that the panel should have, and its limit
_MIN_CLEARANCE_M = 0.4  # least distance from the camera
_BEFORE_S, _AFTER_S = 3.0, 6.0  # the panel should be visible that long before and after it starts to move


def path_comes(t: F64, T_world_cam: F64, begin: float, last: float) -> F64:
    """Return T_world_panel (N, 4, 4) of a panel that comes in from the left at `begin` (s) and for `last`
    seconds sways about 1 m before the camera, on a smooth path of its own through the world; NaN while
    absent."""
    ahead = _smoothed(t, _horizontal(T_world_cam[:, :3, 2]), 0.7)
    centre = _smoothed(t, T_world_cam[:, :3, 3], 0.7)
    aside = _enter_offset(t, begin, last) + _SWAY_M * np.sin(2 * np.pi * (t - begin) / _SWAY_S)
    T = _upright_poses(centre, _horizontal(ahead), _DISTANCE_M, aside)
    T[(t < begin) | (t > begin + last)] = np.nan
    return T


def path_follows(t: F64, T_world_cam: F64, begin: float, last: float) -> F64:
    """Return T_world_panel (N, 4, 4) of a panel that moves with the camera: fixed at the left of its view, 1
    m away."""
    aside = _enter_offset(t, begin, last) - 0.35
    R, zero = np.tile(np.eye(3), (len(t), 1, 1)), np.zeros(len(t))
    T = T_world_cam @ se3.from_rt(R, np.stack([aside, zero, zero + _DISTANCE_M], axis=1))
    T[(t < begin) | (t > begin + last)] = np.nan
    return np.asarray(T, np.float64)


def path_starts(
    t: F64, T_world_cam: F64, camera: Camera, panel: Panel, last: float, speed: float = 0.15
) -> F64:
    """Return T_world_panel (N, 4, 4) of a panel that rests in the room, starts to move aside at `speed` (m/s)
    after 30 to 55 % of the recording for `last` seconds, and rests again. Place and time are those where it
    fills about 40 % of the view. Raises ValueError where the camera comes too near everywhere."""
    best, best_path = -np.inf, None
    for begin, T in _candidate_placements(t, T_world_cam):
        moved = speed * (t - begin).clip(0, last)
        path = np.tile(T, (len(t), 1, 1))
        path[:, :3, 3] += moved[:, None] * T[:3, 0]
        if _clearance(panel, se3.inverse(path) @ T_world_cam) < _MIN_CLEARANCE_M:
            continue
        near = np.flatnonzero((t > begin - _BEFORE_S) & (t < begin + _AFTER_S))[::8]
        view_share = share_of_view(camera, panel, se3.inverse(T_world_cam[near]) @ path[near])
        if (
            score := float(
                (view_share.clip(0, _TARGET_VIEW_SHARE) - 2 * (view_share - _MAX_VIEW_SHARE).clip(0)).mean()
            )
        ) > best:
            best, best_path = score, path
    if best_path is None:
        raise ValueError("no place for a panel that the camera does not run into")
    return best_path


def _candidate_placements(t: F64, T_world_cam: F64) -> Iterator[tuple[float, F64]]:
    """Yield (time at which it starts, T_world_panel at rest): before the camera about then."""
    span = t[-1] - t[0]
    for begin in np.arange(t[0] + 0.3 * span, t[0] + 0.55 * span, 0.5):
        for k in np.searchsorted(t, begin + np.array([-1.5, 0.0, 1.5, 3.0])).clip(0, len(t) - 1):
            ahead, eye = _horizontal(T_world_cam[k : k + 1, :3, 2]), T_world_cam[k : k + 1, :3, 3]
            for metres in (1.0, 1.4, 1.8):
                yield float(begin), _upright_poses(eye, ahead, metres, np.zeros(1))[0]


def _clearance(panel: Panel, T_panel_cam: F64) -> float:
    """Return the least distance from cameras to the panel, m."""
    p = T_panel_cam[:, :3, 3]
    beyond = np.maximum(np.abs(p) - (panel.width / 2, panel.height / 2, 0.0), 0)
    return float(np.linalg.norm(beyond, axis=1).min())


def _enter_offset(t: F64, begin: float, last: float) -> F64:
    """Return the offset to the right, m: in from the left, and out again."""
    inside = np.minimum(t - begin, begin + last - t) / _ENTER_S
    out: F64 = -_START_ASIDE_M * (1 - inside.clip(0, 1))
    return out


def _upright_poses(centre: F64, ahead: F64, metres: float, aside: F64) -> F64:
    """Return T (N, 4, 4), upright, `metres` ahead of `centre` (N, 3) and `aside` to the right, its back to
    `ahead`."""
    down = np.tile([0.0, 0.0, -1.0], (len(ahead), 1))
    right = np.cross(down, ahead)
    R = np.stack([right, down, ahead], axis=-1)
    return se3.from_rt(R, centre + metres * ahead + aside[:, None] * right)


def _horizontal(directions: F64) -> F64:
    """Return unit vectors (N, 3) without their vertical part."""
    flat = directions * (1.0, 1.0, 0.0)
    out: F64 = flat / np.linalg.norm(flat, axis=1, keepdims=True).clip(1e-6)
    return out


def _smoothed(t: F64, values: F64, sigma: float) -> F64:
    """Return (N, 3) smoothed over time by a Gaussian of `sigma` s."""
    weights = np.exp(-0.5 * ((t[:, None] - t[None, :]) / sigma) ** 2)
    out: F64 = weights @ values / weights.sum(axis=1, keepdims=True)
    return out
