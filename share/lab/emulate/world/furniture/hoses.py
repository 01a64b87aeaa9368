"""Fire hoses: reels, rolled on a rack, hung up to dry; extinguishers and hydrants."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.world.furniture.parts import box_on, corner_posts, front_print, pick_material
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, concat_shapes, cylinder, tube


def rolled_hose(rng: Rng, radius: float, wide: float = 0.075) -> Shape:
    """A rolled hose standing on its edge, its coupling in the middle; the roll's axis along y."""
    skin, metal = pick_material(rng, "hose"), pick_material(rng, "galvanised")
    out = [cylinder((0, -wide, radius), radius, wide, skin, skin, axis="y", sides=20, rng=rng)]
    out.append(cylinder((0, -wide - 0.02, radius), 0.035, 0.02, metal, metal, axis="y", sides=10, rng=rng))
    rings = np.arange(0.06, radius - 0.01, 0.045)
    for r in rings:  # windings
        out.append(
            cylinder((0, -wide - 0.006, radius), float(r), 0.006, skin, None, axis="y", sides=20, rng=rng)
        )
    return concat_shapes(out)


def hose_rack(rng: Rng, width: float, rows: int) -> Shape:
    """An open frame with rolled hoses standing side by side on its boards."""
    depth, pitch, paint = 0.35, 0.5, pick_material(rng, "steel")
    height = 0.1 + rows * pitch
    out = [corner_posts(width, depth, height, 0.04, paint, rng)]
    for k in range(rows):
        z = 0.1 + k * pitch
        out.append(box_on((0, -depth / 2, z - 0.02), (width - 0.08, depth - 0.01, 0.02), paint, rng))
        out.append(box_on((0, -depth + 0.02, z + 0.07), (width - 0.08, 0.02, 0.03), paint, rng))
        x = -width / 2 + 0.22
        while x < width / 2 - 0.2:
            if rng.random() < 0.8:
                out.append(rolled_hose(rng, rng.uniform(0.15, 0.2)).placed_at(x, -0.12, z))
            x += 0.42
    return concat_shapes(out)


def hose_reel(rng: Rng) -> Shape:
    """A hose reel on a wall bracket; its axis at 1.2 m."""
    skin, hose, z = Material("lacquer", 0, gray=70), pick_material(rng, "hose"), 1.2
    out = [cylinder((0, y, z), 0.3, 0.015, skin, skin, axis="y", sides=24, rng=rng) for y in (-0.06, -0.24)]
    out.append(cylinder((0, -0.225, z), 0.24, 0.165, hose, None, axis="y", sides=20, rng=rng))
    out.append(cylinder((0, -0.28, z), 0.05, 0.28, skin, skin, axis="y", sides=12, rng=rng))
    end = [
        (0.22, -0.15, z),
        (0.26, -0.16, z - 0.25),
        (0.24, -0.14, z - 0.6),
        (0.15, -0.12, z - 0.7),
        (0.1, -0.1, z - 0.6),
    ]
    out.append(tube(end, 0.016, hose, sides=8, rng=rng))
    return concat_shapes([*out, front_print(rng, -0.2, z + 0.36, 0.4, 0.2, "sign")])


def drying_hoses(rng: Rng, count: int, height: float) -> Shape:
    """Hoses hung over pegs on a wall, their ends down."""
    metal, out = pick_material(rng, "galvanised"), []
    for k in range(count):
        x, skin = (k - (count - 1) / 2) * 0.3, pick_material(rng, "hose")
        out.append(cylinder((x, -0.16, height), 0.05, 0.16, metal, metal, axis="y", sides=10, rng=rng))
        for side in (-1, 1):
            end = rng.uniform(0.3, 1.0)
            out.append(box_on((x + side * 0.075, -0.08, end), (0.045, 0.09, height - end), skin, rng))
            out.append(
                cylinder((x + side * 0.075, -0.08, end - 0.1), 0.035, 0.1, metal, metal, sides=10, rng=rng)
            )
        out.append(box_on((x, -0.08, height), (0.195, 0.09, 0.06), skin, rng))
    return concat_shapes(out)


def extinguisher(rng: Rng) -> Shape:
    """A fire extinguisher on its bracket, with its sign above."""
    red, metal = Material("lacquer", 1, gray=75), pick_material(rng, "galvanised")
    return concat_shapes(
        [
            cylinder((0, -0.1, 0.6), 0.075, 0.42, red, red, sides=14, rng=rng),
            cylinder((0, -0.1, 1.02), 0.075, 0.06, red, None, sides=14, rng=rng, top=0.025),
            box_on((0, -0.12, 1.08), (0.04, 0.12, 0.06), metal, rng),
            box_on((0, -0.0125, 0.7), (0.05, 0.025, 0.3), metal, rng),
            tube(
                [(0.03, -0.13, 1.1), (0.1, -0.14, 1.05), (0.11, -0.13, 0.85), (0.1, -0.12, 0.7)],
                0.012,
                Material("rubber"),
                6,
                rng,
            ),
            front_print(rng, -0.05, 0.7, 0.1, 0.16, "label", -0.176),
            front_print(rng, -0.1, 1.35, 0.2, 0.2, "sign"),
        ]
    )
