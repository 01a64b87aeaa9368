"""A user's own room from a glTF 2.0 file (.gltf or .glb): y up and metres, as the format says.

All nodes belong to the shell, so nothing is removed for paths; triangles are turned to face the room, since
many models are boxes inside out. Colours become albedo: base-colour textures and factors as linear luminance
(Rec. 709); vertex colours in 16 steps, one a triangle. Lamps are added under the ceiling on a grid, because
few files have any.
"""

from __future__ import annotations

from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from share.errors import DataError, UsageError, install_hint
from share.lab.emulate.types import Mesh
from share.lab.emulate.world.build import MAX_ALBEDO, MIN_ALBEDO
from share.lab.emulate.world.gltf_file import MAX_TRIANGLES, read_gltf
from share.lab.emulate.world.layout import Layout, Light, Piece
from share.lab.emulate.world.materials import GivenMaterial
from share.lab.emulate.world.mesh import Shape, concat_shapes
from share.lab.emulate.world.noise import PICTURE_TEXELS
from share.lab.emulate.world.ray_casting import RayCaster
from share.types import F32, F64, I64, U8

MAX_PICTURES = 400
MIN_EXTENT_M, MAX_EXTENT_M = 1.0, 200.0  # m, along any axis
_ROW_BLOCK = 256  # rows of a texture
_GRAY_STEPS = 16  # of vertex colours
_LAMP_PITCH = 2.5  # m
_Z_UP = np.array([(1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1.0)])
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def load_gltf(path: Path) -> Layout:
    """Return the room in a glTF file, its lower corner at the origin, z up. Raises UsageError where the file
    or a package is missing, DataError where it is not a glTF file or not a room."""
    path = Path(path)
    if not path.is_file():
        raise UsageError(f"{path}: no such file")
    try:
        pieces = _room_pieces(_read_scene(path), path)
    except (DataError, UsageError):
        raise
    except Exception as error:  # trimesh and its image decoders raise any type
        lines = str(error).splitlines() or [type(error).__name__]
        raise DataError(f"{path}: not a readable glTF 2.0 file: {lines[0]:.200}") from None
    low, high = concat_shapes(*[p.shape for p in pieces]).bounding_box
    _check_size(path, pieces, high - low)
    T_room_file = np.eye(4)
    T_room_file[:3, 3] = -low
    shapes = [p.shape.transformed(T_room_file) for p in pieces]
    meshes = face_inwards([s.mesh for s in shapes], high - low)
    shell = tuple(Piece(p.name, replace(s, mesh=m)) for p, s, m in zip(pieces, shapes, meshes, strict=True))
    x, y, z = (high - low).tolist()
    return Layout(path.stem, 0, (x, y, z), shell, (), _ceiling_lamps(shell, high - low))


def _read_scene(path: Path) -> Any:
    try:
        import trimesh
    except ImportError:
        raise UsageError(f"a glTF room: {install_hint('trimesh', 'emulate')}") from None
    if path.suffix.lower() not in (".gltf", ".glb"):
        raise UsageError(f"{path}: expected a glTF file (.gltf or .glb)")
    data, files = read_gltf(path)
    return trimesh.load_scene(BytesIO(data), path.suffix[1:].lower(), resolver=files)


def _room_pieces(scene: Any, path: Path) -> list[Piece]:
    pictures: dict[int, GivenMaterial] = {}
    out = []
    for node in sorted(scene.graph.nodes_geometry):
        T, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not len(getattr(geometry, "faces", ())):
            continue  # points and lines
        shape = _node_shape(geometry, _Z_UP @ np.asarray(T, float), pictures)
        if shape is not None:
            out.append(Piece(str(node), shape))
    if not out:
        raise DataError(f"{path}: holds no triangles")
    return out


def _node_shape(geometry: Any, T: F64, pictures: dict[int, GivenMaterial]) -> Shape | None:
    """Return a node's triangles in the room, each with its own corners and normal; None where all are too
    thin to see."""
    corners = np.asarray(geometry.triangles, float) @ T[:3, :3].T + T[:3, 3]
    if np.linalg.det(T[:3, :3]) < 0:  # mirrored
        corners = corners[:, ::-1]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    is_visible = length > 1e-10
    if not is_visible.any() or not np.isfinite(corners).all():
        return None
    uv, layer, materials = _node_colours(geometry, pictures)
    if np.linalg.det(T[:3, :3]) < 0:
        uv = uv[:, ::-1]
    n = int(is_visible.sum())
    mesh = Mesh(
        vertices=corners[is_visible].reshape(-1, 3).astype(np.float32),
        normals=np.repeat(normal[is_visible] / length[is_visible, None], 3, axis=0).astype(np.float32),
        uv=uv[is_visible].reshape(-1, 2).astype(np.float32),
        layer=np.repeat(layer[is_visible], 3).astype(np.int32),
        faces=np.arange(3 * n, dtype=np.int32).reshape(-1, 3),
    )
    return Shape(mesh, materials)


def _node_colours(
    geometry: Any, pictures: dict[int, GivenMaterial]
) -> tuple[F64, np.ndarray, tuple[GivenMaterial, ...]]:
    """Return uv (F, 3, 2), layer (F,) and the pictures that it indexes."""
    count, visual = len(geometry.faces), geometry.visual
    uv = np.zeros((count, 3, 2))
    if visual.kind == "texture":
        material = visual.material
        if getattr(material, "baseColorTexture", None) is not None and visual.uv is not None:
            uv = np.asarray(visual.uv, float)[geometry.faces] * (1, -1) + (0, 1)  # trimesh counts v upwards
        return uv, np.zeros(count, int), (_material_picture(material, pictures),)
    rgb = np.asarray(visual.face_colors, float)[:, :3] / 255  # COLOR_0 is linear
    step = np.minimum((rgb @ _LUMINANCE * _GRAY_STEPS).astype(int), _GRAY_STEPS - 1)
    grays = [_gray_picture((k + 0.5) / _GRAY_STEPS, pictures, -1 - k) for k in range(_GRAY_STEPS)]
    return uv, step, tuple(grays)


def _material_picture(material: Any, pictures: dict[int, GivenMaterial]) -> GivenMaterial:
    """Return a material's base colour as a picture, drawn once per material."""
    key = id(material)
    if key not in pictures:
        factor = getattr(material, "baseColorFactor", None)
        gain = 1.0 if factor is None else float(np.asarray(factor, float)[:3] / 255 @ _LUMINANCE)
        texture = getattr(material, "baseColorTexture", None)
        pictures[key] = GivenMaterial(
            _to_albedo(
                np.full((PICTURE_TEXELS, PICTURE_TEXELS), gain)
                if texture is None
                else gain * _linear_luminance(texture)
            )
        )
    return pictures[key]


def _gray_picture(level: float, pictures: dict[int, GivenMaterial], key: int) -> GivenMaterial:
    if key not in pictures:
        pictures[key] = GivenMaterial(_to_albedo(np.full((PICTURE_TEXELS, PICTURE_TEXELS), level)))
    return pictures[key]


def _linear_luminance(texture: Any) -> F32:
    """Return the luminance (P, P) 0..1 of an sRGB texture (IEC 61966-2-1)."""
    import cv2

    pixels = np.asarray(texture.convert("RGB"))
    light = np.empty(pixels.shape[:2])
    for top in range(0, len(light), _ROW_BLOCK):  # in blocks: it takes 50 bytes a pixel
        rgb = pixels[top : top + _ROW_BLOCK].astype(np.float32) / 255
        some = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4) @ _LUMINANCE
        light[top : top + _ROW_BLOCK] = some
    smaller = min(light.shape) >= PICTURE_TEXELS
    interpolation = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(
        cv2.resize(light.astype(np.float32), (PICTURE_TEXELS, PICTURE_TEXELS), interpolation=interpolation),
        np.float32,
    )


def _to_albedo(light: F64 | F32) -> U8:
    out: U8 = (255 * light).clip(MIN_ALBEDO, MAX_ALBEDO).round().astype(np.uint8)
    return out


def _check_size(path: Path, pieces: list[Piece], extent: F64) -> None:
    triangles = sum(len(p.shape.mesh.faces) for p in pieces)
    pictures = len({m for p in pieces for m in p.shape.materials})
    if extent.min() < MIN_EXTENT_M or extent.max() > MAX_EXTENT_M:
        x, y, z = extent
        raise DataError(
            f"{path}: {x:.3g} x {y:.3g} x {z:.3g} m (z up) is no room: glTF is in metres with y up"
        )
    if triangles > MAX_TRIANGLES:
        raise DataError(f"{path}: {triangles} triangles, at most {MAX_TRIANGLES}: simplify it")
    if pictures > MAX_PICTURES:
        raise DataError(f"{path}: {pictures} materials, at most {MAX_PICTURES}: merge some")


def _ceiling_lamps(shell: tuple[Piece, ...], extent: F64) -> tuple[Light, ...]:
    """Return panels 0.25 m under whatever is above the middle of the room's height, on a grid."""
    scene = RayCaster(concat_shapes(*[p.shape for p in shell]).mesh.triangles)
    nx, ny = (max(1, round(float(e) / _LAMP_PITCH)) for e in extent[:2])
    x, y = np.meshgrid((np.arange(nx) + 0.5) / nx * extent[0], (np.arange(ny) + 0.5) / ny * extent[1])
    start = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, extent[2] / 2)]).astype(np.float32)
    hit, weights = scene.first_hits(start, np.tile(np.array([0, 0, 1], np.float32), (len(start), 1)))
    corners = scene.triangles[hit]
    top = np.where(hit >= 0, (corners[..., 2] * weights).sum(1), extent[2])
    heights = np.maximum(top - 0.25, (start[:, 2] + top) / 2)
    return tuple(
        Light((float(a), float(b), float(h)), size=(0.6, 0.6))
        for (a, b, _), h in zip(start, heights, strict=True)
    )


# Triangles face the room.

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
