"""Solids and sheets of triangles with a material per face, to build furniture from.

Faces look outwards (counter-clockwise from outside). Every planar face has its own corners, so corners that
share vertices are one patch of the light map. uv: u runs along, v runs DOWN (row 0 of a picture is its top).
`rng` shifts surfaces in their picture, so that equal boxes look different.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from share.lab.emulate.types import Mesh
from share.lab.emulate.world.materials import GivenMaterial, Material
from share.types import F64, I64

Rng = np.random.Generator

SIDES = ("-x", "+x", "-y", "+y", "bottom", "top")
Skins = Material | Mapping[str, Material | None]  # one for all, or by side; "side" names the upright
# ones, "all" whatever is not named; None leaves a face out

DECAL_OFFSET_M = 0.003  # distance of a decal from its surface
_PRINT_INSET = 0.004  # of a picture; keeps prints clear of their neighbours


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh with a `layer` that indexes `materials`: its pictures are not drawn yet."""

    mesh: Mesh
    materials: tuple[Material | GivenMaterial, ...]

    def transformed(self, T: F64) -> Shape:
        """Return the shape moved by the rigid transform T (4, 4)."""
        return replace(self, mesh=transform_mesh(self.mesh, T))

    def placed_at(self, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Shape:
        """Return the shape turned about the vertical by `yaw` rad, then shifted."""
        c, s = np.cos(yaw), np.sin(yaw)
        return self.transformed(np.array([(c, -s, 0, x), (s, c, 0, y), (0, 0, 1, z), (0, 0, 0, 1.0)]))

    @property
    def bounding_box(self) -> F64:
        """Return lower and upper corner (2, 3) m."""
        v = self.mesh.vertices.astype(float)
        return np.stack([v.min(0), v.max(0)])


def transform_mesh(mesh: Mesh, T: F64) -> Mesh:
    """Return `mesh` moved by the rigid transform T (4, 4)."""
    R, t = T[:3, :3], T[:3, 3]
    return replace(
        mesh,
        vertices=(mesh.vertices @ R.T + t).astype(np.float32),
        normals=(mesh.normals @ R.T).astype(np.float32),
    )


def concat_shapes(*shapes: Shape) -> Shape:
    """Return one shape of all; equal materials are shared. Raises ValueError for none."""
    materials = tuple(dict.fromkeys(m for shape in shapes for m in shape.materials))
    number = {m: i for i, m in enumerate(materials)}
    layers = [np.array([number[m] for m in s.materials], np.int32)[s.mesh.layer] for s in shapes]
    return Shape(replace(join_meshes([s.mesh for s in shapes]), layer=np.concatenate(layers)), materials)


def join_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Return one mesh of meshes that index the same pictures. Raises ValueError for none."""
    if not meshes:
        raise ValueError("no mesh to join")
    first = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return Mesh(
        vertices=np.concatenate([m.vertices for m in meshes]),
        normals=np.concatenate([m.normals for m in meshes]),
        uv=np.concatenate([m.uv for m in meshes]),
        layer=np.concatenate([m.layer for m in meshes]),
        faces=np.concatenate([m.faces + np.int32(k) for m, k in zip(meshes, first, strict=False)]),
    )


def with_faces(shape: Shape, faces: I64) -> Shape:
    """Return the shape with only these triangles, by index (F,), and their corners."""
    mesh = shape.mesh
    used, number = np.unique(mesh.faces[faces], return_inverse=True)
    columns = {name: getattr(mesh, name)[used] for name in ("vertices", "normals", "uv", "layer")}
    return replace(shape, mesh=Mesh(**columns, faces=number.reshape(-1, 3).astype(np.int32)))


def quad(
    corner: ArrayLike, along: ArrayLike, up: ArrayLike, skin: Material, rng: Rng | None = None, cell: int = 0
) -> Shape:
    """Return a parallelogram: lower left corner (3,) m and the two edges (3,) m from it, as seen from its
    front, which is where `along` x `up` points. A print fills it with its picture number `cell`."""
    a, u = np.asarray(along, float), np.asarray(up, float)
    corners = np.asarray(corner, float) + np.array([0 * a, a, a + u, u])
    if skin.is_fitted:
        uv = _print_cell(skin, cell)
    else:
        width, height = np.sqrt(a @ a), np.sqrt(u @ u)
        shear = a @ u / width
        down = -np.sqrt(max(height**2 - shear**2, 0.0))
        flat = np.array([(0, 0), (width, 0), (width + shear, down), (shear, down)])
        uv = flat / skin.extent + _random_shift(rng)
    return _planar_shape(corners, uv, skin)


def decal(
    corner: ArrayLike,
    along: ArrayLike,
    up: ArrayLike,
    skin: Material,
    rng: Rng | None = None,
    cell: int = 0,
    offset: float = DECAL_OFFSET_M,
) -> Shape:
    """Return a `quad` that is `offset` m off the surface that its corner lies on."""
    n = np.cross(np.asarray(along, float), np.asarray(up, float))
    return quad(np.asarray(corner, float) + offset * n / np.linalg.norm(n), along, up, skin, rng, cell)


def polygon(corners: ArrayLike, skin: Material, rng: Rng | None = None) -> Shape:
    """Return a convex planar polygon (N, 3) m, counter-clockwise from its front; u along its first edge."""
    p = np.asarray(corners, float)
    a = (p[1] - p[0]) / np.linalg.norm(p[1] - p[0])
    n = np.cross(p[1] - p[0], p[2] - p[0])
    u = np.cross(n / np.linalg.norm(n), a)
    flat = np.stack([(p - p[0]) @ a, -(p - p[0]) @ u], axis=1)
    if skin.is_fitted:
        low, high = flat.min(0), flat.max(0)
        corner = _print_cell(skin, 0)
        uv = corner[3] + (flat - low) / (high - low) * (corner[1] - corner[3])
    else:
        uv = flat / skin.extent + _random_shift(rng)
    return _planar_shape(p, uv, skin)


def box(low: ArrayLike, high: ArrayLike, skins: Skins, rng: Rng | None = None, cell: int = 0) -> Shape:
    """Return an axis-aligned box from corner `low` to corner `high` (3,) m, seen from outside. Prints stand
    upright on its sides; those of its top are read from -y."""
    lo, d = np.asarray(low, float), np.asarray(high, float) - np.asarray(low, float)
    if (d <= 0).any():
        raise ValueError(f"box: extent {d} must be positive")
    x, y, z = np.diag(d)
    faces = {
        "-x": (lo + y, -y, z),
        "+x": (lo + x, y, z),
        "-y": (lo, x, z),
        "+y": (lo + x + y, -x, z),
        "bottom": (lo + y, x, -y),
        "top": (lo + z, x, y),
    }
    faces_found = {side: _side_material(skins, side) for side in SIDES}
    return concat_shapes(*[quad(*faces[side], skin, rng, cell) for side, skin in faces_found.items() if skin])


def prism(
    outline: ArrayLike, low: float, high: float, side: Material, caps: Material | None, rng: Rng | None = None
) -> Shape:
    """Return an upright prism over a convex outline (N, 2) m, counter-clockwise from above."""
    p = np.asarray(outline, float)
    bottom, top = (np.column_stack([p, np.full(len(p), z)]) for z in (low, high))
    steps = np.roll(bottom, -1, axis=0) - bottom
    start, shift = np.cumsum([0, *np.linalg.norm(steps, axis=1)]), _random_shift(rng)
    out = [
        _shift_uv(quad(b, s, (0, 0, high - low), side), shift + np.array([u / (side.extent or 1), 0]))
        for b, s, u in zip(bottom, steps, start, strict=False)
    ]
    if caps:
        out += [polygon(top, caps, rng), polygon(bottom[::-1], caps, rng)]
    return concat_shapes(*out)


def cylinder(
    centre: ArrayLike,
    radius: float,
    height: float,
    side: Material,
    caps: Material | None = None,
    axis: str = "z",
    sides: int = 16,
    rng: Rng | None = None,
    top: float | None = None,
) -> Shape:
    """Return a cylinder from the middle of its base (3,) m along `axis`; a cone where the radius at its end
    (`top`, m) differs. `caps=None` leaves it open."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    low = np.column_stack([ring * radius, np.zeros(sides)])
    high = np.column_stack([ring * (radius if top is None else top), np.full(sides, height)])
    pitch, shift = 2 * radius * np.sin(np.pi / sides), _random_shift(rng)
    out = []
    for k in range(sides):
        corners = np.stack([low[k], low[k - sides + 1], high[k - sides + 1], high[k]])
        u = np.array([k, k + 1, k + 1, k]) * pitch
        v = -np.array([0, 0, height, height])
        uv = np.stack([u, v], axis=1) / (side.extent or 2 * np.pi * radius) + shift
        out.append(_planar_shape(corners, uv, side))
    if caps:
        out += [polygon(high, caps, rng)] if top != 0 else []
        out += [polygon(low[::-1], caps, rng)]
    return concat_shapes(*out).transformed(_axis_transform(axis, centre))


def tube(path: ArrayLike, radius: float, skin: Material, sides: int = 8, rng: Rng | None = None) -> Shape:
    """Return a pipe or hose of `radius` m along a line of points (N, 3) m, closed at its ends."""
    p = np.asarray(path, float)
    tangent = np.gradient(p, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across, over = np.empty_like(p), np.empty_like(p)
    across[0] = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    for i, t in enumerate(tangent):  # parallel transport, without twist
        a = across[max(i - 1, 0)]
        a = a - t * (a @ t)
        across[i] = a / np.linalg.norm(a)
        over[i] = np.cross(t, across[i])
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = p[:, None] + radius * (
        np.cos(angle)[None, :, None] * across[:, None] + np.sin(angle)[None, :, None] * over[:, None]
    )
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    pitch, shift, extent = 2 * radius * np.sin(np.pi / sides), _random_shift(rng), skin.extent or 1.0
    out = []
    for i in range(len(p) - 1):
        for k in range(sides):
            j = (k + 1) % sides
            corners = np.stack([ring[i, k], ring[i, j], ring[i + 1, j], ring[i + 1, k]])
            u, v = np.array([k, k + 1, k + 1, k]) * pitch, -length[[i, i, i + 1, i + 1]]
            out.append(_planar_shape(corners, np.stack([u, v], axis=1) / extent + shift, skin))
    ends = [polygon(ring[0, ::-1], skin, rng), polygon(ring[-1], skin, rng)]
    return concat_shapes(*out + ends)


def panels(
    corner: ArrayLike, along: ArrayLike, up: ArrayLike, skins: Sequence[Material], pitch: float, rng: Rng
) -> Shape:
    """Return a rectangle in panels of about `pitch` m, each with one of `skins` at its own offset: a large
    wall or floor without repetition. Joints show; use the building's own spacing as `pitch`."""
    c, a, u = (np.asarray(v, float) for v in (corner, along, up))
    columns, rows = (max(1, round(float(np.linalg.norm(v)) / pitch)) for v in (a, u))
    return concat_shapes(
        *[
            quad(
                c + a * i / columns + u * j / rows,
                a / columns,
                u / rows,
                skins[int(rng.integers(len(skins)))],
                rng,
            )
            for j in range(rows)
            for i in range(columns)
        ]
    )


def _side_material(skins: Skins, side: str) -> Material | None:
    if isinstance(skins, Material):
        return skins
    group = "all" if side in ("top", "bottom") else "side"
    return skins.get(side, skins.get(group, skins.get("all")))


def _random_shift(rng: Rng | None) -> F64:
    return np.zeros(2) if rng is None else rng.random(2)


def _shift_uv(shape: Shape, uv: F64) -> Shape:
    """Shift surfaces in their picture; prints stay."""
    if shape.materials[0].is_fitted:
        return shape
    return replace(shape, mesh=replace(shape.mesh, uv=(shape.mesh.uv + uv).astype(np.float32)))


def _print_cell(skin: Material, cell: int) -> F64:
    """Return uv (4, 2) of print number `cell`: lower left, lower right, upper right, upper left."""
    n = skin.cells
    row, column = divmod(cell % (n * n), n)
    low, high = _PRINT_INSET, 1 - _PRINT_INSET
    corners = np.array([(low, high), (high, high), (high, low), (low, low)])
    return np.asarray((corners + np.array([column, row])) / n)


def _planar_shape(corners: F64, uv: F64, skin: Material) -> Shape:
    """Return a convex planar face (N, 3) m as a fan of triangles."""
    n = _cross_product(corners[1] - corners[0], corners[2] - corners[0])
    count = len(corners)
    normals = np.empty((count, 3), np.float32)
    normals[:] = n / np.sqrt(n @ n)
    mesh = Mesh(
        vertices=corners.astype(np.float32),
        normals=normals,
        uv=uv.astype(np.float32),
        layer=np.zeros(count, np.int32),
        faces=np.array([(0, k, k + 1) for k in range(1, count - 1)], np.int32),
    )
    return Shape(mesh, (skin,))


def _cross_product(a: F64, b: F64) -> F64:
    """Return the cross product of vectors (3,): np.cross costs ten times as much on so few numbers, and a
    room has 10^4 faces."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def _axis_transform(axis: str, origin: ArrayLike) -> F64:
    """Return the transform that takes +z to the named axis and 0 to `origin`."""
    T = np.eye(4)
    T[:3, :3] = {
        "x": np.array([(0, 0, 1), (1, 0, 0), (0, 1, 0)]),
        "y": np.array([(0, 1, 0), (0, 0, 1), (1, 0, 0)]),
        "z": np.eye(3),
    }[axis]
    T[:3, 3] = origin
    return T
