"""Baked light: the light on every texel of the light map from the lamps, directly and by reflection.

Direct light by rays to points on the lamps, the rest by radiosity over rays that are cast once: a texel sees
the same 16 places at every bounce. Texels of a 4 x 4 pattern take different samples of one low-discrepancy
set, and a filter over five texels averages them within a patch, so that soft shadows are smooth with few
rays. Nothing is random: the same room has the same light.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from share.lab.emulate.types import I32, Mesh
from share.lab.emulate.world.layout import Light
from share.lab.emulate.world.light_atlas import LightAtlas, pad_patches, texel_mask, unfold_patches
from share.lab.emulate.world.ray_casting import RayCaster
from share.types import F32, U8

UNIT_LIGHT = 100  # light that makes albedo the gray level
TEXELS_PER_M = 16.0
MAX_TEXELS = 600_000
_BOUNCES = 4
_GATHER_RAYS = 16  # rays into the half space, per texel
# of the mean light: lamps above the first get four rays, below the second none
_STRONG_SHARE, _WEAK_SHARE = 0.05, 0.004
_RAY_OFFSET_M = 1e-3  # offset of ray origins above their surface
_MAX_BACK_SHARE = 0.3  # of rays that meet back faces; above it the texel lies in a solid or under a decal
_RAY_CHUNK = 1 << 19  # rays at a time


def bake_light(
    mesh: Mesh,
    albedo: F32,
    glows: NDArray[np.bool_],
    lights: Sequence[Light],
    ambient: float,
    brightness: float,
) -> tuple[F32, U8]:
    """Return light_uv (V, 2) and light_map (H, W) of a room. albedo (L,): share of light that each picture
    reflects; glows (L,): which pictures emit light. Raises ValueError without a lamp."""
    if not lights:
        raise ValueError("a room needs a lamp")
    is_lamp_vertex = glows[mesh.layer]
    atlas = unfold_patches(mesh, is_lamp_vertex.astype(np.int32), TEXELS_PER_M, MAX_TEXELS)
    dark = ~is_lamp_vertex[mesh.faces[:, 0]]
    scene = RayCaster(mesh.triangles[dark])
    start = atlas.position + _RAY_OFFSET_M * atlas.normal
    lamp = is_lamp_vertex[atlas.vertex[atlas.patch]]
    source, valid, weight = _radiosity_links(mesh, mesh.faces[dark], albedo, atlas, scene, start)
    valid &= ~lamp
    direct = _smooth_within_patches(_direct_light(atlas, scene, start, lights), valid, atlas)
    total = direct
    for _ in range(_BOUNCES):
        total = direct + _smooth_within_patches((weight * total[source]).sum(1), valid, atlas)
    mean = float(np.average(total[valid], weights=atlas.area[valid]))
    level = UNIT_LIGHT * brightness * ((1 - ambient) * total / mean + ambient)
    level[lamp] = 255
    image = np.zeros(atlas.shape, np.float32)
    image[atlas.row, atlas.column] = level
    return atlas.uv, pad_patches(image, atlas).clip(0, 255).round().astype(np.uint8)


def _pattern_index(atlas: LightAtlas) -> NDArray[np.int64]:
    """Return the index of each texel (T,) in the 4 x 4 pattern."""
    return atlas.row % 4 * 4 + atlas.column % 4


def _pattern_samples(count: int) -> F32:
    """Return (16, count, 2) points in the unit square: the R2 sequence (Roberts, 2018), dealt out so that
    every texel of the pattern has `count` well-spread points and all 16 together fill the square evenly."""
    k = np.arange(16 * count)
    points = (0.5 + k[:, None] * np.array([0.7548776662466927, 0.5698402909980532])) % 1
    return np.asarray(points.reshape(count, 16, 2).swapaxes(0, 1), np.float32)


def _direct_light(atlas: LightAtlas, scene: RayCaster, start: F32, lights: Sequence[Light]) -> F32:
    """Return direct light (T,) of the lamps: form factor of a one-sided diffuse panel, with shadows."""
    centres = [_lamp_gain(atlas, start, light, np.asarray(light.position, np.float32)) for light in lights]
    mean = float(np.average(np.sum(centres, axis=0), weights=atlas.area))
    out = np.zeros(len(start), np.float32)
    for light, centre_light in zip(lights, centres, strict=True):
        for rays, is_lit in (
            (4, centre_light > _STRONG_SHARE * mean),
            (1, (centre_light > _WEAK_SHARE * mean) & (centre_light <= _STRONG_SHARE * mean)),
        ):
            texels = np.nonzero(is_lit)[0]
            out[texels] += _lamp_light(atlas, scene, start, light, rays, texels)
    return out


def _lamp_light(
    atlas: LightAtlas, scene: RayCaster, start: F32, light: Light, rays: int, texels: NDArray[np.intp]
) -> F32:
    """Return the light of one lamp on the texels `texels`, by `rays` rays each."""
    x, y = _lamp_edges(light)
    spots = _pattern_samples(rays) - 0.5
    places = np.asarray(light.position, np.float32) + spots[..., :1] * x + spots[..., 1:] * y
    tile, out = _pattern_index(atlas)[texels], np.zeros(len(texels), np.float32)
    for k in range(rays):
        for i in range(0, len(texels), _RAY_CHUNK):
            part = texels[i : i + _RAY_CHUNK]
            place = places[tile[i : i + _RAY_CHUNK], k]
            gain = _lamp_gain(atlas, start, light, place, part)
            out[i : i + _RAY_CHUNK] += gain * ~scene.is_blocked(start[part], place - start[part]) / rays
    return out


def _lamp_edges(light: Light) -> tuple[F32, F32]:
    """Return the two edges (3,) m of a lamp."""
    n = np.asarray(light.facing, float) / np.linalg.norm(light.facing)
    x = np.cross((0, 1, 0), n) if abs(n[1]) < 0.9 else np.cross((0, 0, 1), n)
    x /= np.linalg.norm(x)
    y = np.cross(n, x)
    return (x * light.size[0]).astype(np.float32), (y * light.size[1]).astype(np.float32)


def _lamp_gain(
    atlas: LightAtlas, start: F32, light: Light, place: F32, part: NDArray[np.intp] | slice = slice(None)
) -> F32:
    """Return power cos(a) cos(b) / (pi r^2), with r not below 0.2 m."""
    direction = place - start[part]
    r2 = np.maximum((direction * direction).sum(1), 0.04)
    facing = np.asarray(light.facing, np.float32) / np.float32(np.linalg.norm(light.facing))
    cos_surface, cos_lamp = (direction * atlas.normal[part]).sum(1), -(direction @ facing)
    return np.asarray(
        light.power / np.pi * np.maximum(cos_surface, 0) * np.maximum(cos_lamp, 0) / (r2 * r2), np.float32
    )


def _radiosity_links(
    mesh: Mesh, faces: I32, albedo: F32, atlas: LightAtlas, scene: RayCaster, start: F32
) -> tuple[I32, NDArray[np.bool_], F32]:
    """Return the sources of each texel's indirect light: indices (T, G) of the texels that its rays meet and
    their weights (T, G), and which texels (T,) are in the open."""
    number = np.zeros(atlas.shape, np.int32)
    number[atlas.row, atlas.column] = np.arange(len(start))
    x, y = _tangents(atlas.normal)
    tile, directions = _pattern_index(atlas), _cosine_directions(_pattern_samples(_GATHER_RAYS))
    source = np.zeros((len(start), _GATHER_RAYS), np.int32)
    weight = np.zeros((len(start), _GATHER_RAYS), np.float32)
    backs = np.zeros(len(start), np.float32)
    step = max(1, _RAY_CHUNK // _GATHER_RAYS)
    for i in range(0, len(start), step):
        part = slice(i, i + step)
        local = directions[tile[part]]
        frame = np.stack([x[part], y[part], atlas.normal[part]], axis=1)
        ray_directions = np.einsum("tgk,tkj->tgj", local, frame).reshape(-1, 3)
        hit, bary = scene.first_hits(np.repeat(start[part], _GATHER_RAYS, axis=0), ray_directions)
        corners = faces[hit]
        back = (hit >= 0) & ((mesh.normals[corners[:, 0]] * ray_directions).sum(1) > 0)
        place = (atlas.uv[corners] * bary[..., None]).sum(1) * (atlas.shape[1], atlas.shape[0])
        column, row = place.astype(np.int32).T
        source[part] = number[row, column].reshape(-1, _GATHER_RAYS)
        is_front = ((hit >= 0) & ~back).reshape(-1, _GATHER_RAYS)
        share = albedo[mesh.layer[corners[:, 0]]].reshape(-1, _GATHER_RAYS) * is_front
        weight[part] = share / np.maximum(is_front.sum(1, keepdims=True), 1)
        backs[part] = back.reshape(-1, _GATHER_RAYS).mean(1)
    return source, backs < _MAX_BACK_SHARE, weight


def _tangents(normal: F32) -> tuple[F32, F32]:
    """Return two axes (T, 3) orthogonal to each unit vector; equal vectors have equal axes."""
    helper = np.eye(3, dtype=np.float32)[np.abs(normal).argmin(1)]
    x = np.cross(normal, helper)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return x, np.cross(normal, x)


def _cosine_directions(points: F32) -> F32:
    """Map the unit square (..., 2) to directions (..., 3) about z with cosine density (Malley's method)."""
    r, turn = np.sqrt(points[..., 0]), 2 * np.pi * points[..., 1]
    up = np.sqrt(np.maximum(1 - points[..., 0], 0))
    return np.stack([r * np.cos(turn), r * np.sin(turn), up], axis=-1).astype(np.float32)


def _smooth_within_patches(light: F32, valid: NDArray[np.bool_], atlas: LightAtlas) -> F32:
    """Return light (T,) averaged over the pattern within each patch, from valid texels only; the others take
    that of the nearest valid texels of their patch."""
    import cv2

    kernel = np.array([1, 2, 2, 2, 1], np.float32) / 8
    known = texel_mask(atlas, valid)
    image, share = np.zeros(atlas.shape, np.float32), known.astype(np.float32)
    image[atlas.row, atlas.column] = light * valid
    out = np.zeros(len(light), np.float32)
    is_missing = np.ones(len(light), bool)
    while is_missing.any():
        value, amount = (
            cv2.sepFilter2D(m, -1, kernel, kernel, borderType=cv2.BORDER_CONSTANT) for m in (image, share)
        )
        amount = amount[atlas.row, atlas.column]
        reached = is_missing & (amount > 1e-3)
        if not reached.any():
            break  # a patch inside a solid, never visible
        out[reached] = value[atlas.row, atlas.column][reached] / amount[reached]
        is_missing &= ~reached
        image[atlas.row[reached], atlas.column[reached]] = out[reached]
        share[atlas.row[reached], atlas.column[reached]] = 1
    return out
