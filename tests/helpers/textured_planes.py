"""A room of textured planes, drawn by a ray through every pixel: images, and exact surfaces in them."""

from __future__ import annotations

import cv2
import numpy as np

from share.geometry import se3
from share.geometry.camera import Camera, rays
from share.mapping.recognition.patch_alignment import ImageView
from share.types import F32, F64, U8, KeyframeImage
from share.vision import corners
from share.vision.keyframe_images import compress

CAMERA = Camera(640, 480, 385.0, 385.0, 319.5, 239.5)
T_BODY_CAM = se3.exp(np.array([0.1, -1.4, 0.2, 0.03, -0.05, 0.01]))
_TEXELS_PER_M, _TEXTURE_SIDE = 150.0, 1024  # the texture repeats every 7 m
_SPACING_PX = 12


class Planes:
    """Planes n X = 1, n (P, 3) 1/m, in the world; each hides what is behind it. The first camera looks along
    world z from the origin."""

    def __init__(self, planes: list[list[float]], seed: int) -> None:
        self.planes = np.array(planes)
        rng = np.random.default_rng(seed)
        coarse = [rng.normal(0, 1, (_TEXTURE_SIDE // n,) * 2).astype(np.float32) for n in (4, 8, 32)]
        size = (_TEXTURE_SIDE, _TEXTURE_SIDE)
        mixed = sum(cv2.resize(one, size, interpolation=cv2.INTER_CUBIC) for one in coarse)
        self.texture = (128 + 35 * mixed).clip(0, 255).astype(np.uint8)

    def seen_from(self, T_world_cam: F64, noise: np.random.Generator, sigma: float = 1.5) -> U8:
        """Image (H, W) with gray noise of `sigma`."""
        rotation, position = T_world_cam[:3, :3], T_world_cam[:3, 3]
        normals = self.planes @ rotation / (1 - self.planes @ position)[:, None]
        rho = np.array([_linear_image(n) for n in normals])
        hit, rho = rho.argmax(axis=0), rho.max(axis=0)
        x, y = (
            (_TEXELS_PER_M * (position[k] + _linear_image(rotation[k]) / rho) + 317.0 * hit) % _TEXTURE_SIDE
            for k in (0, 1)
        )
        image = cv2.remap(
            self.texture,
            x.astype(np.float32),
            y.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP,
        )
        grain = sigma * noise.standard_normal(image.shape, np.float32)
        return (image + grain).clip(0, 255).astype(np.uint8)

    def surfaces(self, T_world_cam: F64, uv: F64) -> F64:
        """The plane (N, 3), in the camera, that is seen at uv (N, 2)."""
        rho = self._rho(T_world_cam, rays(uv) @ T_world_cam[:3, :3].T)
        n = self.planes[rho.argmax(axis=1)]
        out: F64 = n @ T_world_cam[:3, :3] / (1 - n @ T_world_cam[:3, 3])[:, None]
        return out

    def _rho(self, T_world_cam: F64, direction: F64) -> F64:
        """Inverse depth (N, P) along rays (N, 3) in the world."""
        out: F64 = direction @ self.planes.T / (1 - self.planes @ T_world_cam[:3, 3])
        return out


def _linear_image(of_ray: F64) -> F32:
    """of_ray (3,) times the ray of each pixel (H, W)."""
    u = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    v = (np.arange(CAMERA.height) - CAMERA.cy) / CAMERA.fy
    return np.add.outer(of_ray[1] * v + of_ray[2], of_ray[0] * u).astype(np.float32)


def corner_px(image: U8, count: int) -> F32:
    return corners.detect(image, np.zeros((0, 2), np.float32), count, _SPACING_PX)


def image_view(
    planes: Planes,
    T_world_body: F64,
    rng: np.random.Generator,
    count: int = 80,
    rho_sigma: float = 0.005,
    depth_scale: float = 1.0,
) -> ImageView:
    """What an agent at T_world_body (4, 4) sends of it, with errors of inverse depth of `rho_sigma`, and all
    depths times `depth_scale`."""
    T_world_cam = T_world_body @ T_BODY_CAM
    image = planes.seen_from(T_world_cam, rng)
    uv = CAMERA.normalise(corner_px(image, count).astype(np.float64))
    return with_depth_errors(planes, T_world_body, compress(image), uv, rng, rho_sigma, depth_scale)


def with_depth_errors(
    planes: Planes,
    T_world_body: F64,
    jpeg: U8,
    uv: F64,
    rng: np.random.Generator,
    rho_sigma: float,
    depth_scale: float = 1.0,
) -> ImageView:
    plane = planes.surfaces(T_world_body @ T_BODY_CAM, uv)
    rho = (rays(uv) * plane).sum(axis=1, keepdims=True)
    wrong = plane * (1 + rng.normal(0, rho_sigma, rho.shape) / rho) / depth_scale
    image = KeyframeImage(jpeg, uv, wrong, np.full(len(uv), rho_sigma))
    return ImageView(image, CAMERA, T_BODY_CAM)
