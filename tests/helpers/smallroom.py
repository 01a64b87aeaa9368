"""A small furnished room for tests: a table, a box, a pole, a poster, one lamp."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.world.layout import Layout, Light, Piece
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Shape, box, concat_shapes, cylinder, decal, panels

SIZE = (5.0, 4.0, 3.0)


def table(rng: np.random.Generator) -> Shape:
    top = box((0, 0, 0.7), (1.6, 0.8, 0.74), Material("wood"), rng)
    legs = [
        box((x, y, 0), (x + 0.05, y + 0.05, 0.7), Material("steel"), rng)
        for x in (0.0, 1.55)
        for y in (0.0, 0.75)
    ]
    return concat_shapes(top, *legs)


def shell(rng: np.random.Generator) -> tuple[Piece, ...]:
    x, y, z = SIZE
    walls, floor = [Material("plaster", k) for k in range(2)], [Material("screed")]
    return (
        Piece("floor", panels((0, 0, 0), (x, 0, 0), (0, y, 0), floor, 1.0, rng)),
        Piece("ceiling", panels((0, y, z), (x, 0, 0), (0, -y, 0), [Material("ceiling")], 2.4, rng)),
        Piece("south", panels((x, 0, 0), (-x, 0, 0), (0, 0, z), walls, 3, rng)),
        Piece("north", panels((0, y, 0), (x, 0, 0), (0, 0, z), walls, 3, rng)),
        Piece("west", panels((0, 0, 0), (0, y, 0), (0, 0, z), walls, 3, rng)),
        Piece("east", panels((x, y, 0), (0, -y, 0), (0, 0, z), walls, 3, rng)),
    )


def small_room(seed: int = 1) -> Layout:
    rng = np.random.default_rng((seed, 77))
    pieces = (
        Piece("table", table(rng).placed_at(0.5, 0.5)),
        Piece("box", box((3.0, 2.0, 0.0), (4.0, 3.0, 1.0), Material("cardboard"), rng)),
        Piece("pole", cylinder((1.0, 3.0, 0), 0.1, 3.0, Material("concrete"), Material("concrete"))),
        Piece(
            "poster", decal((0, 1.0, 1.5), (0, 0.6, 0), (0, 0, 0.8), Material("poster"), cell=2), solid=False
        ),
        Piece("lamp", box((2.2, 1.9, 2.9), (2.8, 2.1, 2.95), Material("lamp")), solid=False),
    )
    return Layout("small", seed, SIZE, shell(rng), pieces, (Light((2.5, 2.0, 2.85), size=(0.6, 0.2)),))
