"""The visible part of a surface in a pinhole view: chunks of triangles outside the view are skipped."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from share.geometry.camera import Camera
from share.lab.emulate.types import I32, Mesh
from share.types import F64, I64

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


CHUNK_TRIANGLES = 16  # triangles per chunk
_GRID_CELLS = 1023  # cells per side of the grid of the Z-order curve


@dataclass(frozen=True, eq=False)
class ChunkedSurface:
    """faces (C, CHUNK, 3): corners, neighbours together, padded with empty triangles. corners (C, CHUNK, 3,
    3) m; planes (C, CHUNK, 4): unit normal n and offset d, n . x = d; centre (C, 3) and radius (C,) m of a
    sphere around each chunk."""

    faces: I32
    corners: F64
    planes: F64
    centre: F64
    radius: F64

    @property
    def bounding_sphere(self) -> tuple[F64, float]:
        """Return centre (3,) and radius of a sphere around all of it, m."""
        low, high = self.corners.min(axis=(0, 1, 2)), self.corners.max(axis=(0, 1, 2))
        return (low + high) / 2, float(np.linalg.norm(high - low)) / 2

    def visible_chunks(self, planes: F64, T_surface_cam: F64) -> I64:
        """Return chunks that may be within `planes` (S, 3) of a view, sorted by the distance of their far
        end: near chunks hide others, which then cost less."""
        centre = (self.centre - T_surface_cam[:3, 3]) @ T_surface_cam[:3, :3]
        chunks = np.flatnonzero((centre @ planes.T > -self.radius[:, None]).all(axis=1))
        far = np.sqrt((centre[chunks] ** 2).sum(axis=1)) + self.radius[chunks]
        return chunks[np.argsort(far, kind="stable")]

    def inverse_depth_slopes(self, chunks: I64, T_surface_cam: F64) -> F64:
        """Return slopes (T, 3) of the chunks' triangles: inverse depth at normalised (u, v) is slope . (u, v,
        1)."""
        planes = self.planes[chunks].reshape(-1, 4)
        distance = planes[:, 3] - planes[:, :3] @ T_surface_cam[:3, 3]
        distance = np.where(np.abs(distance) < 1e-12, np.inf, distance)  # seen edge-on: covers no pixel
        slopes: F64 = planes[:, :3] @ T_surface_cam[:3, :3] / distance[:, None]
        return slopes


def chunked_surface(mesh: Mesh) -> ChunkedSurface:
    """Return `mesh` cut into chunks."""
    faces = _faces_in_z_order(mesh)
    filler = np.broadcast_to(faces[-1, 0], (-len(faces) % CHUNK_TRIANGLES, 3))
    faces = np.ascontiguousarray(np.concatenate([faces, filler]).reshape(-1, CHUNK_TRIANGLES, 3), np.int32)
    corners = mesh.vertices[faces].astype(np.float64)
    low, high = corners.min(axis=(1, 2)), corners.max(axis=(1, 2))
    radius = np.linalg.norm(high - low, axis=1) / 2
    return ChunkedSurface(faces, corners, _planes(corners), (low + high) / 2, radius)


def _faces_in_z_order(mesh: Mesh) -> I32:
    """Return faces sorted by their centres along a Z-order curve (Morton 1966)."""
    centres = mesh.triangles.mean(axis=1)
    span = max(float(np.ptp(centres, axis=0).max()), 1e-6)
    cells = ((centres - centres.min(axis=0)) / span * _GRID_CELLS).astype(np.int64)
    code = np.zeros(len(cells), np.int64)
    for bit in range(_GRID_CELLS.bit_length()):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return mesh.faces[np.argsort(code, kind="stable")]


def _planes(corners: F64) -> F64:
    a, b, c = np.moveaxis(corners, -2, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
    return np.concatenate([normal, (normal * a).sum(axis=-1, keepdims=True)], axis=-1)
