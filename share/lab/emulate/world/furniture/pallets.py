"""Pallets (EN 13698: 1.2 x 0.8 x 0.144 m): bare, in a pile, loaded."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.world.furniture.cartons import carton
from share.lab.emulate.world.furniture.parts import box_on, front_print, pick_material
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, box, concat_shapes

WIDTH, DEPTH, HEIGHT = 1.2, 0.8, 0.144


def pallet(rng: Rng) -> Shape:
    """Top boards over stringers over nine blocks over skids."""
    skin, out = pick_material(rng, "wood"), []
    for y in (-0.05, -DEPTH / 2, 0.05 - DEPTH):
        out.append(box_on((0, y, 0), (WIDTH, 0.1, 0.022), skin, rng))
        out += [box_on((x, y, 0.022), (0.145, 0.1, 0.078), skin, rng) for x in (-0.5275, 0, 0.5275)]
    out += [box_on((x, -DEPTH / 2, 0.1), (0.145, DEPTH, 0.022), skin, rng) for x in (-0.5275, 0, 0.5275)]
    tops = -np.linspace(0.06, DEPTH - 0.06, 6)
    out += [box_on((0, y, 0.122), (WIDTH, 0.11, 0.022), skin, rng) for y in tops]
    return concat_shapes(out)


def pallet_pile(rng: Rng, count: int) -> Shape:
    """A stack of bare pallets, slightly out of line."""
    shift = rng.uniform(-0.03, 0.03, count)
    return concat_shapes([pallet(rng).placed_at(float(s), 0, k * HEIGHT) for k, s in enumerate(shift)])


def loaded_pallet(rng: Rng, height: float) -> Shape:
    """A pallet with goods up to `height` m: cartons in layers, sacks, or a block under foil."""
    goods = (_cartons, _sacks, _wrapped_block)[int(rng.integers(3))]
    return concat_shapes(
        [pallet(rng), *(s.placed_at(0, 0, HEIGHT) for s in goods(rng, max(height - HEIGHT, 0.3)))]
    )


def _cartons(rng: Rng, height: float) -> list[Shape]:
    nx, ny = int(rng.integers(2, 5)), int(rng.integers(1, 4))
    h = float(rng.uniform(0.2, 0.4))
    w, d, out = WIDTH / nx, DEPTH / ny, []
    for k in range(max(1, int(height / h))):
        for i in range(nx):
            for j in range(ny):
                if k and k >= int(height / h) - 1 and rng.random() < 0.3:
                    continue  # the top layer is incomplete
                x = (i + 0.5) * w - WIDTH / 2
                out.append(carton(rng, w - 0.012, d - 0.012, h - 0.002).placed_at(x, -j * d - 0.006, k * h))
    return out


def _sacks(rng: Rng, height: float) -> list[Shape]:
    skin, h = Material("fabric", 1, gray=float(rng.choice([120, 165]))), 0.13
    out = []
    for k in range(max(1, int(height / h))):
        for x in (-0.3, 0.3):
            for y in (-0.2, -0.6):
                size = (0.56 + rng.uniform(-0.02, 0.02), 0.37, h - 0.004)
                out.append(box_on((x, y, k * h), size, skin, rng))
        out.append(front_print(rng, -0.5, k * h + 0.02, 0.4, 0.09, "label", -0.785))
    return out


def _wrapped_block(rng: Rng, height: float) -> list[Shape]:
    low, high = (-WIDTH / 2 + 0.02, -DEPTH + 0.02, 0), (WIDTH / 2 - 0.02, -0.02, height)
    body = box(low, high, {"all": pick_material(rng, "foil"), "bottom": None}, rng)
    return [body, front_print(rng, 0.05, height * 0.6, 0.21, 0.15, "label", -DEPTH + 0.02)]
