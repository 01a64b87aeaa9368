"""Triangles as the graphics library holds them, in chunks that are drawn only where they may be seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from share.emulate.types import Mesh
from share.geometry.camera import Camera
from share.types import F32, F64, I64

CHUNK = 64  # triangles that are drawn or left out together
_NEAR = 0.05  # m


@dataclass(frozen=True, eq=False)
class Surface:
    """faces (C, CHUNK, 3) int32, neighbours together, filled up with empty triangles; centre (C, 3) and
    radius (C,) m of a sphere around each chunk; planes (C, CHUNK, 4): unit normal and offset, n . x = d."""

    vertices: Any  # moderngl buffer
    indices: Any
    faces: np.ndarray
    centre: F64
    radius: F64
    planes: F64

    def visible(self, camera: Camera, T_surface_cam: F64) -> I64:
        """Chunks that may be in the image, nearest first."""
        centre = (self.centre - T_surface_cam[:3, 3]) @ T_surface_cam[:3, :3]
        seen = (centre @ _sides(camera).T > -self.radius[:, None]).all(axis=1)
        chunks = np.flatnonzero(seen)
        return chunks[np.argsort((centre[chunks] ** 2).sum(axis=1), kind="stable")]

    def planes_seen(self, chunks: I64, T_surface_cam: F64) -> F32:
        """Of these chunks' triangles, (T, 4): inverse depth at normalised (u, v) is k . (u, v, 1, 0)."""
        planes = self.planes[chunks].reshape(-1, 4)
        offset = planes[:, 3] - planes[:, :3] @ T_surface_cam[:3, 3]
        offset = np.where(np.abs(offset) < 1e-12, np.inf, offset)  # seen edge-on: never drawn
        out = np.zeros((len(planes), 4), np.float32)
        out[:, :3] = planes[:, :3] @ T_surface_cam[:3, :3] / offset[:, None]
        return out


def upload(context: Any, mesh: Mesh, light_uv: F32 | None = None) -> Surface:
    """`mesh` on the graphics side: position, normal, uv, layer and light_uv of each vertex, interleaved."""
    light = np.zeros((len(mesh.vertices), 2)) if light_uv is None else light_uv
    columns = (mesh.vertices, mesh.normals, mesh.uv, mesh.layer[:, None], light)
    faces = _chunks(mesh)
    triangles = mesh.vertices[faces].astype(np.float64)
    low, high = triangles.min(axis=(1, 2)), triangles.max(axis=(1, 2))
    return Surface(
        vertices=context.buffer(np.concatenate(columns, axis=1).astype("f4").tobytes()),
        indices=context.buffer(reserve=faces.nbytes, dynamic=True),
        faces=faces,
        centre=(low + high) / 2,
        radius=np.linalg.norm(high - low, axis=1) / 2,
        planes=_planes(triangles),
    )


def _chunks(mesh: Mesh) -> np.ndarray:
    """Faces along a Z-order curve through their centres (Morton 1966), cut into chunks."""
    centres = mesh.triangles.mean(axis=1)
    low = centres.min(axis=0)
    cells = ((centres - low) / max(float(np.ptp(centres, axis=0).max()), 1e-6) * 1023).astype(np.int64)
    code = np.zeros(len(cells), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    faces = mesh.faces[np.argsort(code, kind="stable")]
    filled = np.concatenate([faces, np.repeat(faces[-1:, :1], -len(faces) % CHUNK, axis=0).repeat(3, axis=1)])
    return np.ascontiguousarray(filled.reshape(-1, CHUNK, 3), np.int32)


def _planes(triangles: F64) -> F64:
    a, b, c = np.moveaxis(triangles, -2, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
    return np.concatenate([normal, (normal * a).sum(axis=-1, keepdims=True)], axis=-1)


def _sides(camera: Camera) -> F64:
    """Inward unit normals (5, 3) of the view frustum, camera frame; the outermost pixels' outer edges."""
    left, right = (-0.5 - camera.cx) / camera.fx, (camera.width - 0.5 - camera.cx) / camera.fx
    top, bottom = (-0.5 - camera.cy) / camera.fy, (camera.height - 0.5 - camera.cy) / camera.fy
    sides = np.array([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom], [0, 0, 1.0]])
    return sides / np.linalg.norm(sides, axis=1, keepdims=True)


def projection(camera: Camera, far: float) -> F64:
    """To clip coordinates: pixel centres at integers, rows downwards, from `_NEAR` to `far`."""
    P = np.zeros((4, 4))
    P[0, 0], P[0, 2] = 2 * camera.fx / camera.width, 2 * (camera.cx + 0.5) / camera.width - 1
    P[1, 1], P[1, 2] = 2 * camera.fy / camera.height, 2 * (camera.cy + 0.5) / camera.height - 1
    P[2, 2], P[2, 3] = (far + _NEAR) / (far - _NEAR), -2 * far * _NEAR / (far - _NEAR)
    P[3, 2] = 1
    return P
