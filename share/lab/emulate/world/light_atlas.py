"""Planar patches of a mesh and their places in the light map.

A patch is connected by corners of the same place and normal: the panels of a wall are one patch, so there is
no seam between them. Its outermost texel centres lie on its bounds, and one more texel on every side repeats
them, so that bilinear sampling never reaches a neighbour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from share.lab.emulate.types import I32, Mesh
from share.types import F32, F64, I64

_PATCH_PADDING = 1
_WELD_M = 5e-4  # corners nearer than this are one
_RIM_INSET_M = 0.004  # inset of lighting at rim texels: a rim often lies in another solid


@dataclass(frozen=True, eq=False)
class LightAtlas:
    """uv (V, 2): each vertex's place in the map, 0..1. shape: rows and columns of the map. Then one entry for
    each texel inside a patch: row, column (T,), position (T, 3) m, normal (T, 3), area (T,) m^2, patch (T,):
    its index; vertex (patches,): one vertex of each patch."""

    uv: F32
    shape: tuple[int, int]
    row: I64
    column: I64
    position: F32
    normal: F32
    area: F32
    patch: I64
    vertex: I64


def unfold_patches(mesh: Mesh, group: I32, density: float, max_texels: int) -> LightAtlas:
    """Return the patches of `mesh` at `density` texels per metre, fewer where the map would exceed
    `max_texels` texels. Corners of a triangle must have its normal; corners of different `group` (V,) stay
    apart."""
    patch = _patch_numbers(mesh, group)
    first = np.unique(patch, return_index=True)[1]
    normal, along, across = _patch_frames(mesh, patch, first)
    flat = np.stack([(mesh.vertices * e[patch]).sum(1) for e in (along, across)], axis=1)
    low, extent = _patch_bounds(patch, flat, len(first))
    texels = _patch_texels(extent, density, max_texels)
    corner, shape = _pack_shelves(texels + 2 * _PATCH_PADDING)
    place = corner[patch] + _PATCH_PADDING + (flat - low[patch]) / extent[patch] * (texels[patch] - 1) + 0.5
    owner, index = _enumerate_texels(texels)
    slack = np.minimum(_RIM_INSET_M, extent / 4)[owner]
    at = index / (texels[owner] - 1) * extent[owner]
    at = low[owner] + np.clip(at, slack, extent[owner] - slack)
    height = (mesh.vertices[first] * normal).sum(1)
    position = at[:, :1] * along[owner] + at[:, 1:] * across[owner] + (height[:, None] * normal)[owner]
    column, row = (corner[owner] + _PATCH_PADDING + index).T
    return LightAtlas(
        uv=(place / (shape[1], shape[0])).astype(np.float32),
        shape=shape,
        row=row,
        column=column,
        position=position.astype(np.float32),
        normal=normal[owner].astype(np.float32),
        area=(extent.prod(1) / texels.prod(1))[owner].astype(np.float32),
        patch=owner,
        vertex=first,
    )


def pad_patches(image: F32, atlas: LightAtlas) -> F32:
    """Return `image` with the texels around every patch set to their nearest neighbours in it."""
    import cv2

    inside = np.zeros(atlas.shape, bool)
    inside[atlas.row, atlas.column] = True
    spread = cv2.dilate(np.where(inside, image, 0).astype(np.float32), np.ones((3, 3), np.uint8))
    return np.where(inside, image, spread).astype(np.float32)


def _patch_numbers(mesh: Mesh, group: I32) -> I64:
    """Return the index of the patch of each vertex (V,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    key = np.column_stack([np.round(mesh.vertices / _WELD_M), np.round(mesh.normals * 500), group])
    welded = np.unique(key.astype(np.int64), axis=0, return_inverse=True)[1].reshape(-1)
    a, b = welded[mesh.faces[:, [0, 1]]].reshape(-1), welded[mesh.faces[:, [1, 2]]].reshape(-1)
    n = int(welded.max()) + 1
    label = connected_components(coo_array((np.ones(len(a)), (a, b)), (n, n)), directed=False)[1]
    return np.asarray(np.unique(label[welded], return_inverse=True)[1], np.int64)


def _patch_frames(mesh: Mesh, patch: I64, first: I64) -> tuple[F64, F64, F64]:
    """Return normal and two axes (patches, 3) of each patch; the first axis is one of its edges."""
    normal = mesh.normals[first].astype(float)
    edge = np.zeros((len(first), 3))
    owner, steps = patch[mesh.faces[:, 0]], mesh.vertices[mesh.faces[:, 1]] - mesh.vertices[mesh.faces[:, 0]]
    edge[owner[::-1]] = steps[::-1]
    edge -= (edge * normal).sum(1, keepdims=True) * normal
    length = np.linalg.norm(edge, axis=1, keepdims=True)
    other = np.cross(normal, np.eye(3)[np.abs(normal).argmin(1)])
    along = np.where(length > 1e-6, edge / np.maximum(length, 1e-9), other)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return normal, along, np.cross(normal, along)


def _patch_bounds(patch: I64, flat: F64, count: int) -> tuple[F64, F64]:
    """Return lower corner and extent (patches, 2) m."""
    low, high = (np.full((count, 2), v) for v in (np.inf, -np.inf))
    np.minimum.at(low, patch, flat)
    np.maximum.at(high, patch, flat)
    return low, np.maximum(high - low, 1e-6)


def _patch_texels(extent: F64, density: float, max_texels: int) -> I64:
    """Return texels (patches, 2) along each axis, at least two."""
    while True:
        texels = np.maximum(np.ceil(extent * density).astype(np.int64) + 1, 2)
        if texels.prod(1).sum() <= max_texels or density < 1:
            return texels
        density *= 0.9


def _pack_shelves(sizes: I64) -> tuple[I64, tuple[int, int]]:
    """Pack blocks of `sizes` on shelves; return corners (patches, 2), column and row, and the map's shape."""
    width = 1 << int(np.ceil(np.log2(max(np.sqrt(sizes.prod(1).sum() * 1.1), sizes[:, 0].max(), 16))))
    corners = np.zeros_like(sizes)
    x = y = height = 0
    for k in np.lexsort((sizes[:, 0], -sizes[:, 1])).tolist():
        w, h = sizes[k].tolist()
        if x + w > width:
            x, y, height = 0, y + height, 0
        corners[k] = x, y
        x, height = x + w, max(height, h)
    return corners, (y + height, width)


def _enumerate_texels(texels: I64) -> tuple[I64, I64]:
    """Return patch (T,) and column, row (T, 2) in it of every texel."""
    counts = texels.prod(1)
    owner = np.repeat(np.arange(len(texels)), counts)
    rest = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return owner, np.stack([rest % texels[owner, 0], rest // texels[owner, 0]], axis=1)


def texel_mask(atlas: LightAtlas, texels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the map (H, W) with True at `texels` (T,)."""
    out = np.zeros(atlas.shape, bool)
    out[atlas.row, atlas.column] = texels
    return out
