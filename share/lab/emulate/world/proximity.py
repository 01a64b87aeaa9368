"""Exact distances of points from a mesh."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.types import Mesh
from share.types import F64

_PAIR_CHUNK = 400_000  # point-triangle pairs at a time


def is_near_mesh(mesh: Mesh, points: F64, reach: float) -> bool:
    """Return whether any point (N, 3) m is nearer than `reach` m to the mesh, or inside it."""
    low, high = mesh.vertices.min(0) - reach, mesh.vertices.max(0) + reach
    near = points[((points >= low) & (points <= high)).all(axis=1)]
    if not len(near):
        return False
    corners = mesh.triangles.astype(float)
    step = max(1, _PAIR_CHUNK // len(corners))
    return any(
        bool(
            (triangle_distances(corners, part).min(1) < reach).any()
            or (winding_numbers(corners, part) > 0.5).any()
        )
        for part in (near[i : i + step] for i in range(0, len(near), step))
    )


def triangle_distances(corners: F64, points: F64) -> F64:
    """Return distances (N, F) m of points (N, 3) from triangles (F, 3, 3): to the plane where the foot of the
    perpendicular lies inside, else to the nearest edge."""
    p = points[:, None]
    edges = np.roll(corners, -1, axis=1) - corners
    out = np.full((len(points), len(corners)), np.inf)
    normal = np.cross(edges[:, 0], edges[:, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    inside = np.ones(out.shape, bool)
    for k in range(3):
        a, e = corners[:, k], edges[:, k]
        d = p - a
        t = (d * e).sum(-1) / np.maximum((e * e).sum(-1), 1e-18)
        foot = d - np.clip(t, 0, 1)[..., None] * e
        out = np.minimum(out, np.linalg.norm(foot, axis=-1))
        inside &= (d * np.cross(normal, e)).sum(-1) >= 0
    height = np.abs(((p - corners[:, 0]) * normal).sum(-1))
    return np.where(inside, np.minimum(height, out), out)


def winding_numbers(corners: F64, points: F64) -> F64:
    """Return the winding number (N,) of the triangles (F, 3, 3) around each point: about 1 inside a closed
    solid, 0 outside. Solid angles by van Oosterom & Strackee, IEEE TBME 30(2), 1983."""
    a, b, c = (corners[:, k] - points[:, None] for k in range(3))
    na, nb, nc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    top = (a * np.cross(b, c)).sum(-1)
    bottom = na * nb * nc + (a * b).sum(-1) * nc + (b * c).sum(-1) * na + (c * a).sum(-1) * nb
    total: F64 = np.arctan2(top, bottom).sum(1) / (2 * np.pi)
    return total
