"""Walls, floor, ceiling and what carries them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from share.lab.emulate.world.furniture import pillars
from share.lab.emulate.world.furniture.parts import box_on, pick_material
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, concat_shapes, decal, panels, quad
from share.lab.emulate.world.scenes.layout_builder import LayoutBuilder, Wall, outer_walls

BAY_M = 3.0  # about, between columns and girders


def bay_joints(length: float, pitch: float = BAY_M) -> list[float]:
    """Return where the bays of a wall meet, m from its left end, without the ends."""
    count = max(1, round(length / pitch))
    return [length * k / count for k in range(1, count)]


Bands = Sequence[tuple[float, Material]]  # of a wall, lowest first: (upper edge m, material)


def wall_surface(wall: Wall, bands: Bands, rng: Rng, pitch: float = np.inf) -> Shape:
    """Return the wall in bays of about `pitch` m without repetition; the joints between them show."""
    edges, out = [0.0, *bay_joints(wall.length, pitch), wall.length], []
    for left, right in pairwise(edges):
        low = 0.0
        for high, skin in bands:
            out.append(quad((left, 0, low), (right - left, 0, 0), (0, 0, high - low), skin, rng))
            low = high
    return wall.place(concat_shapes(out), 0)


def build_enclosure(
    plan: LayoutBuilder, bands: Bands, floor: Material, ceiling: Material, pitch: float = np.inf
) -> None:
    """The four walls in bays of `pitch` m, the floor in slabs, the ceiling."""
    x, y, z = plan.size
    for wall in outer_walls(plan.size):
        plan.add_to_shell("wall", wall_surface(wall, bands, plan.rng, pitch))
    plan.add_to_shell("floor", panels((0, 0, 0), (x, 0, 0), (0, y, 0), [floor], BAY_M, plan.rng))
    plan.add_to_shell(
        "ceiling", panels((0, y, z), (x, 0, 0), (0, -y, 0), [ceiling], min(pitch, 1e3), plan.rng)
    )


def add_floor_joints(plan: LayoutBuilder) -> None:
    """Sealed joints of the floor slab, where its panels meet."""
    x, y, _ = plan.size
    skin = Material("rubber", 1, gray=62)
    for at in bay_joints(x):
        plan.add_unchecked(
            "joint", decal((at - 0.006, 0, 0), (0.012, 0, 0), (0, y, 0), skin, plan.rng, offset=0.0015)
        )
    for at in bay_joints(y):
        plan.add_unchecked(
            "joint", decal((0, at - 0.006, 0), (x, 0, 0), (0, 0.012, 0), skin, plan.rng, offset=0.001)
        )


def add_columns(plan: LayoutBuilder, walls: Sequence[Wall], height: float) -> None:
    """Half columns of `height` m where the bays of walls meet."""
    skin, wide, deep = pick_material(plan.rng, "steel"), 0.16, 0.12
    for wall in walls:
        for at in bay_joints(wall.length):
            post = box_on((0, -deep / 2, 0), (wide, deep, height), skin, plan.rng)
            plan.add_to_shell("column", wall.place(post, at), is_reserved=True)


def add_girders(plan: LayoutBuilder, height: float) -> None:
    """I-beams across the room under its ceiling, over the columns."""
    x, y, z = plan.size
    for at in bay_joints(x):
        beam = pillars.girder(plan.rng, y, height)
        plan.add_to_shell("girder", beam.placed_at(at, y / 2, z - height, np.pi / 2), is_reserved=True)


def add_skirting(plan: LayoutBuilder, walls: Sequence[Wall]) -> None:
    """A rubber strip of 8 cm along the foot of walls."""
    for wall in walls:
        strip = decal(
            (0, 0, 0), (wall.length, 0, 0), (0, 0, 0.08), Material("rubber"), plan.rng, offset=0.002
        )
        plan.add_unchecked("skirting", wall.place(strip, 0))
