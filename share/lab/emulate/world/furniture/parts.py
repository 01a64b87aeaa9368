"""Small parts that furniture is built from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, box, concat_shapes, decal

Point3 = Sequence[float]

# Pictures of each kind in a room, two by default; few, so that they fit in memory.
VARIANTS = {
    "cardboard": 4,
    "steel": 4,
    "plastic": 4,
    "poster": 5,
    "sign": 5,
    "goods": 3,
    "notice": 3,
    "label": 1,
}


def pick_material(rng: Rng, kind: str) -> Material:
    """Return one of the room's materials of this kind."""
    return Material(kind, int(rng.integers(VARIANTS.get(kind, 2))))


def pick_print(rng: Rng, kind: str) -> tuple[Material, int]:
    """Return one of the room's prints of this kind, and a cell of its picture."""
    skin = pick_material(rng, kind)
    return skin, int(rng.integers(skin.cells**2))


def front_print(
    rng: Rng, x: float, z: float, width: float, height: float, kind: str, y: float = 0.0
) -> Shape:
    """A print of this kind on a front in the plane `y`, lower left corner at (x, z)."""
    skin, cell = pick_print(rng, kind)
    return decal((x, y, z), (width, 0, 0), (0, 0, height), skin, rng, cell)


def box_on(middle: Point3, size: Point3, skin: Material, rng: Rng) -> Shape:
    """A box by the middle of its underside (3,) m and its size (3,) m."""
    half = np.array([size[0] / 2, size[1] / 2, 0])
    low = np.asarray(middle, float) - half
    return box(low, low + np.asarray(size, float), skin, rng)


def strut(start: Point3, end: Point3, thick: float, skin: Material, rng: Rng, wide: float = 0.0) -> Shape:
    """A straight bar from `start` to `end` (3,) m, of section `wide` or `thick` x `thick` m."""
    a, d = np.asarray(start, float), np.asarray(end, float) - np.asarray(start, float)
    length = float(np.linalg.norm(d))
    z = d / length
    x = np.cross(np.eye(3)[1 if abs(z[1]) < 0.9 else 0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = x, np.cross(z, x), z, a
    half = (wide or thick) / 2
    return box((-half, -thick / 2, 0), (half, thick / 2, length), skin, rng).transformed(T)


def corner_posts(width: float, depth: float, height: float, thick: float, skin: Material, rng: Rng) -> Shape:
    """Four upright posts at the corners of a footprint with its back at y = 0."""
    at = [(x, y) for x in (-1, 1) for y in (-depth + thick / 2, -thick / 2)]
    reach = (width - thick) / 2
    return concat_shapes(*[box_on((x * reach, y, 0), (thick, thick, height), skin, rng) for x, y in at])
