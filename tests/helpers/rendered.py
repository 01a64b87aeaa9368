"""Rooms to draw in tests: a textured box with boxes inside, and walls with a checkerboard."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from share.geometry.camera import Camera
from share.lab.emulate.render.context import missing_reason
from share.lab.emulate.types import DrawableRoom, Mesh

WHY_NOT = missing_reason()
needs_opengl = pytest.mark.skipif(WHY_NOT is not None, reason=f"cannot draw here: {WHY_NOT}")

SIZE = (9.0, 6.0, 4.0)
D435I = Camera(640, 480, 383.2, 384.1, 318.7, 242.3)
EUROC = Camera(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76e-05))
OFF_CENTRE = Camera(640, 400, 350.0, 361.0, 251.4, 233.8)


def looking(yaw: float, pitch: float = 0.0, at: tuple[float, float, float] = (4.5, 3.0, 1.6)) -> np.ndarray:
    """T_world_cam of a level camera at `at`, turned left by `yaw` and down by `pitch`, rad."""
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    T[:3, 3] = at
    return T


def box(low: np.ndarray, high: np.ndarray, layer: int, inside: bool = False, shift: float = 0.0) -> Mesh:
    """A box with a picture a metre on every side; `inside` is a room."""
    parts = [_side(low, high, axis, up, layer, inside, shift) for axis in range(3) for up in (0, 1)]
    return joined(parts)


def _side(low, high, axis: int, up: int, layer: int, inside: bool, shift: float) -> Mesh:
    along, across = (axis + 1) % 3, (axis + 2) % 3
    corners = np.repeat(np.array([low], float), 4, axis=0)
    corners[:, axis] = (low, high)[up][axis]
    corners[[1, 2], along], corners[[2, 3], across] = high[along], high[across]
    normal = np.zeros((4, 3))
    normal[:, axis] = (1 if up else -1) * (-1 if inside else 1)
    faces = np.array([[0, 1, 2], [0, 2, 3]]) if up != inside else np.array([[0, 2, 1], [0, 3, 2]])
    uv = corners[:, [along, across]] + shift
    return Mesh(*(a.astype(np.float32) for a in (corners, normal, uv)), np.full(4, layer, np.int32), faces)


def joined(meshes: list[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    columns = [
        np.concatenate([getattr(m, n) for m in meshes]) for n in ("vertices", "normals", "uv", "layer")
    ]
    faces = np.concatenate([m.faces + k for m, k in zip(meshes, starts, strict=True)])
    return Mesh(*columns, faces.astype(np.int32))


def pictures(rng: np.random.Generator, layers: int, size: int = 256) -> np.ndarray:
    """Noise of several scales with patches of other brightness."""
    out = np.zeros((layers, size, size), np.uint8)
    for picture in out:
        soft = sum(
            cv2.resize(
                rng.normal(0, 11, (n, n)).astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC
            )
            for n in (size // 4, size // 8, size // 32)
        )
        for x, y, w, h in rng.integers(8, size // 4, (20, 4)) * (4, 4, 1, 1):
            soft[y : y + h, x : x + w] += rng.normal(0, 30)
        picture[:] = cv2.GaussianBlur(np.clip(125 + soft, 10, 245), (0, 0), 0.8).astype(np.uint8)
    return out


def furnished(boxes: int = 350, movers: dict[str, tuple[Mesh, ...]] | None = None) -> DrawableRoom:
    """Boxes everywhere but in the middle, each with a picture, under light that varies softly."""
    rng = np.random.default_rng((4, boxes))
    size = np.array(SIZE)
    parts = [box(np.zeros(3), size, 0, inside=True)]
    while len(parts) <= boxes:
        centre, half = rng.uniform(0.2, size - 0.2), rng.uniform(0.04, 0.3, 3)
        if np.linalg.norm(centre[:2] - size[:2] / 2) > 1.6:
            parts.append(box(centre - half, centre + half, len(parts) % 16, shift=rng.uniform()))
    mesh = joined(parts)
    light = cv2.resize(rng.uniform(60, 140, (8, 8)), (64, 64), interpolation=cv2.INTER_CUBIC)
    light_uv = (mesh.vertices[:, :2] / size[:2]).astype(np.float32)
    return DrawableRoom(
        "boxes", 0, size, mesh, pictures(rng, 16), light_uv, light.astype(np.uint8), movers or {}
    )


def plain(picture: np.ndarray, movers: dict[str, tuple[Mesh, ...]] | None = None) -> DrawableRoom:
    """An empty room with one picture a metre, evenly lit."""
    mesh = box(np.zeros(3), np.array(SIZE), 0, inside=True)
    light = np.full((4, 4), 100, np.uint8)
    light_uv = np.full((len(mesh.vertices), 2), 0.5, np.float32)
    return DrawableRoom("plain", 0, np.array(SIZE), mesh, picture[None], light_uv, light, movers or {})


def checker(squares: int = 4, size: int = 256) -> np.ndarray:
    """A checkerboard of squares x squares, its edges between texels."""
    cell = np.arange(size) * squares // size
    return np.where((cell[:, None] + cell) % 2, 200, 50).astype(np.uint8)
