"""Find which side of a surface faces the room in users' models: many are boxes inside out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from share.lab.emulate.types import Mesh
from share.lab.emulate.world.ray_casting import RayCaster
from share.types import F32, F64, I64

_RAYS = 256  # from each place
_MAX_PLACES = 400


def face_inwards(meshes: list[Mesh], extent: F64) -> list[Mesh]:
    """Return the meshes of a room (from the origin to `extent` (3,) m) with separate triangles, flipped where
    more rays from places all over the room meet their back than their front."""
    triangles = np.concatenate([m.triangles for m in meshes])
    normals = np.concatenate([m.normals[m.faces[:, 0]] for m in meshes])
    wrong = _front_hits(triangles, normals, extent) < 0
    ends = np.cumsum([len(m.faces) for m in meshes])[:-1]
    return [_flip_triangles(m, w) for m, w in zip(meshes, np.split(wrong, ends), strict=True)]


def _front_hits(triangles: F32, normals: F32, extent: F64) -> I64:
    """Return the rays that meet the front of each triangle (F,) less those that meet its back."""
    scene, directions = RayCaster(triangles), _sphere_directions(_RAYS)
    score = np.zeros(len(triangles), np.int64)
    for place in _grid_places(extent):
        hit, _ = scene.first_hits(np.tile(place, (_RAYS, 1)), directions)
        front = np.where((normals[hit] * directions).sum(1) < 0, 1, -1)
        np.add.at(score, hit[hit >= 0], front[hit >= 0])
    return score


def _grid_places(extent: F64) -> F32:
    """Return a grid (N, 3) m over the room, a metre apart or more."""
    pitch = max(1.0, float(np.cbrt(extent.prod() / _MAX_PLACES)))
    axes = [(np.arange(n) + 0.5) / n * e for e, n in ((e, max(2, round(e / pitch))) for e in extent.tolist())]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    return grid.astype(np.float32)


def _sphere_directions(count: int) -> F32:
    """Return directions (count, 3) evenly over the sphere: the Fibonacci lattice."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1).astype(np.float32)


def _flip_triangles(mesh: Mesh, wrong: np.ndarray) -> Mesh:
    """Flip the triangles `wrong` (F,)."""
    faces, normals = mesh.faces.copy(), mesh.normals.copy()
    normals[faces[wrong]] *= -1
    faces[wrong] = faces[wrong][:, ::-1]
    return replace(mesh, faces=faces, normals=normals)
