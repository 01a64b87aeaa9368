"""Equipment: small objects on the floor, ladders, tables and chairs, fire hoses and extinguishers."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.world.furniture.parts import (
    box_on,
    corner_posts,
    front_print,
    pick_material,
    pick_print,
    strut,
)
from share.lab.emulate.world.furniture.storage import carton
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, box, concat_shapes, cylinder, decal, tube


def cone(rng: Rng) -> Shape:
    """A traffic cone of 0.5 m with a white collar."""
    skin, white = Material("plastic", 0, gray=120), Material("marking")
    return concat_shapes(
        box_on((0, -0.15, 0), (0.3, 0.3, 0.03), Material("rubber"), rng),
        cylinder((0, -0.15, 0.03), 0.115, 0.47, skin, skin, sides=16, rng=rng, top=0.025),
        cylinder((0, -0.15, 0.22), 0.083, 0.12, white, None, sides=16, rng=rng, top=0.059),
    )


def cones(rng: Rng) -> Shape:
    """Two or three cones in a row."""
    count = int(rng.integers(2, 4))
    return concat_shapes(*[cone(rng).placed_at((k - (count - 1) / 2) * 0.36, 0) for k in range(count)])


def bucket(rng: Rng) -> Shape:
    skin = pick_material(rng, "plastic")
    return concat_shapes(
        cylinder((0, -0.16, 0), 0.11, 0.27, skin, None, sides=14, rng=rng, top=0.145),
        cylinder((0, -0.16, 0.005), 0.1, 0.12, skin, skin, sides=14, rng=rng),
        cylinder((0, -0.16, 0.255), 0.155, 0.015, skin, None, sides=14, rng=rng),
    )


def tool_box(rng: Rng) -> Shape:
    """A chest on castors with drawers."""
    skin, metal = pick_material(rng, "lacquer"), pick_material(rng, "galvanised")
    out = [box((-0.35, -0.45, 0.14), (0.35, 0, 0.95), skin, rng)]
    for x in (-0.28, 0.28):
        for y in (-0.4, -0.06):
            out.append(
                cylinder(
                    (x - 0.015, y, 0.055), 0.055, 0.03, Material("rubber"), metal, axis="x", sides=12, rng=rng
                )
            )
            out.append(box_on((x, y, 0.1), (0.05, 0.05, 0.04), metal, rng))
    for z, h in ((0.2, 0.22), (0.44, 0.14), (0.6, 0.14), (0.76, 0.14)):
        out.append(box((-0.32, -0.465, z), (0.32, -0.45, z + h), skin, rng))
        out.append(box_on((0, -0.48, z + h - 0.05), (0.5, 0.03, 0.02), metal, rng))
    return concat_shapes(*out, front_print(rng, -0.3, 0.55 - 0.3, 0.12, 0.1, "label", -0.465))


def hand_truck(rng: Rng) -> Shape:
    """A sack truck parked upright."""
    skin = pick_material(rng, "steel")
    out = [
        tube([(x, -0.12, 0.04), (x, -0.1, 0.6), (x, -0.06, 1.15)], 0.015, skin, 8, rng) for x in (-0.18, 0.18)
    ]
    out += [
        strut((-0.18, -0.12 + 0.05 * z, z), (0.18, -0.12 + 0.05 * z, z), 0.025, skin, rng)
        for z in (0.3, 0.6, 0.9, 1.12)
    ]
    out.append(box_on((0, -0.27, 0), (0.42, 0.28, 0.012), skin, rng))
    out += [
        cylinder((x, -0.09, 0.09), 0.09, 0.05, Material("rubber"), skin, axis="x", sides=14, rng=rng)
        for x in (-0.27, 0.22)
    ]
    return concat_shapes(*out)


def crate(rng: Rng) -> Shape:
    """A slatted wooden crate of 0.5-1 m."""
    w, d, h = (float(v) for v in rng.uniform((0.5, 0.4, 0.4), (1.0, 0.6, 0.9)))
    skin, inner = pick_material(rng, "wood"), pick_material(rng, "plywood")
    out = [box((-w / 2 + 0.02, -d + 0.02, 0.03), (w / 2 - 0.02, -0.02, h - 0.01), inner, rng)]
    for z in (0.0, h / 2 - 0.05, h - 0.1):
        out += [box_on((0, y, z), (w, 0.02, 0.1), skin, rng) for y in (-d + 0.01, -0.01)]
        out += [box_on((x * (w - 0.02) / 2, -d / 2, z), (0.02, d - 0.04, 0.1), skin, rng) for x in (-1, 1)]
    if rng.random() < 0.7:
        out.append(front_print(rng, -0.12, 0.13, 0.24, min(0.2, h / 2 - 0.2), "sign", -d + 0.02))
    return concat_shapes(*out)


# Ladders.


def leaning_ladder(rng: Rng, length: float) -> Shape:
    """A ladder of `length` m that leans against a wall in the plane y = 0, its feet 0.3 of that away."""
    skin, foot = pick_material(rng, "galvanised"), -0.28 * length
    top = (length**2 - foot**2) ** 0.5
    out = [strut((x, foot, 0.02), (x, -0.04, top), 0.03, skin, rng, 0.06) for x in (-0.2, 0.2)]
    for k in range(1, int(length / 0.28)):
        s = k * 0.28 / length
        y, z = foot + (-0.04 - foot) * s, 0.02 + (top - 0.02) * s
        out.append(strut((-0.17, y, z), (0.17, y, z), 0.03, skin, rng))
    return concat_shapes(*out)


def step_ladder(rng: Rng, height: float) -> Shape:
    """An open step ladder, climbed from -y."""
    skin, d = pick_material(rng, "galvanised"), 0.55 * height
    out = []
    for x in (-0.22, 0.22):
        out.append(strut((x, -d, 0.015), (x, -0.32 * height, height), 0.03, skin, rng, 0.06))
        out.append(strut((x, -0.02, 0.015), (x, -0.26 * height, height - 0.03), 0.025, skin, rng))
    count = max(2, round(height / 0.25))
    for k in range(1, count):
        s = k / count
        out.append(box_on((0, -d + 0.23 * height * s, height * s), (0.38, 0.1, 0.03), skin, rng))
    out.append(box_on((0, -0.3 * height, height), (0.5, 0.28, 0.04), pick_material(rng, "plastic"), rng))
    return concat_shapes(*out)


# Tables, workbenches, benches and chairs.


def workbench(rng: Rng, width: float) -> Shape:
    """A bench 0.6 m deep and 0.86 m high with a drawer block, a shelf below, a vice and small objects on its
    top."""
    depth, top, skin, wood = 0.6, 0.86, pick_material(rng, "steel"), pick_material(rng, "wood")
    out = [
        corner_posts(width, depth, top - 0.05, 0.06, skin, rng),
        box((-width / 2, -depth, top - 0.05), (width / 2, 0, top), wood, rng),
        box(
            (-width / 2 + 0.06, -depth + 0.1, 0.2),
            (width / 2 - 0.06, -0.06, 0.225),
            pick_material(rng, "plywood"),
            rng,
        ),
        *_drawers(rng, width, depth, top),
        box_on((width / 2 - 0.2, -depth + 0.12, top), (0.12, 0.22, 0.14), pick_material(rng, "steel"), rng),
    ]
    out += [s.placed_at(0, -0.05, top) for s in _table_clutter(rng, width - 0.7, depth - 0.2)]
    return concat_shapes(*out)


def _drawers(rng: Rng, width: float, depth: float, top: float) -> list[Shape]:
    skin, x = pick_material(rng, "steel"), -width / 2 + 0.35
    out = [box_on((x, -depth / 2, 0.28), (0.46, depth - 0.14, top - 0.34), skin, rng)]
    for k in range(3):
        z = 0.3 + k * 0.17
        out.append(box_on((x, -depth + 0.06, z), (0.43, 0.025, 0.15), skin, rng))
        out.append(
            box_on((x, -depth + 0.035, z + 0.09), (0.16, 0.025, 0.018), pick_material(rng, "galvanised"), rng)
        )
    return out


def _table_clutter(rng: Rng, width: float, depth: float) -> list[Shape]:
    """Cartons, cans and a flat sheet on a bench, side by side."""
    out, x = [], -width / 2
    while x < width / 2 - 0.3:
        kind, d = rng.random(), rng.uniform(0.15, depth)
        if kind < 0.4:
            out.append(carton(rng, 0.24, min(d, 0.35), rng.uniform(0.08, 0.3)).placed_at(x + 0.14, -0.05))
        elif kind < 0.7:
            skin = pick_material(rng, "plastic")
            out.append(
                cylinder((x + 0.1, -d, 0), 0.06, rng.uniform(0.1, 0.25), skin, skin, sides=12, rng=rng)
            )
        elif kind < 0.9:
            out.append(_paper_sheet(rng, x + 0.02, -depth + 0.05))
        x += rng.uniform(0.28, 0.5)
    return out


def _paper_sheet(rng: Rng, x: float, y: float) -> Shape:
    """A sheet of paper that lies flat."""
    skin, cell = pick_print(rng, "notice")
    return decal((x, y, 0), (0.21, 0, 0), (0, 0.297, 0), skin, rng, cell)


def table(rng: Rng, width: float) -> Shape:
    """A plain table of 0.74 m with small objects on it."""
    depth, top = 0.8, 0.74
    out = [
        corner_posts(width, depth, top - 0.03, 0.05, pick_material(rng, "steel"), rng),
        box((-width / 2, -depth, top - 0.03), (width / 2, 0, top), pick_material(rng, "wood"), rng),
    ]
    return concat_shapes(
        *out + [s.placed_at(0, -0.1, top) for s in _table_clutter(rng, width - 0.2, depth - 0.3)]
    )


def bench(rng: Rng, width: float) -> Shape:
    """A slatted bench of a changing room."""
    wood, metal = pick_material(rng, "wood"), pick_material(rng, "steel")
    out = [box_on((0, y, 0.42), (width, 0.09, 0.03), wood, rng) for y in (-0.06, -0.17, -0.28)]
    for x in (-width / 2 + 0.15, width / 2 - 0.15):
        out.append(box_on((x, -0.17, 0.38), (0.04, 0.32, 0.04), metal, rng))
        out += [box_on((x, y, 0), (0.04, 0.04, 0.38), metal, rng) for y in (-0.05, -0.29)]
    return concat_shapes(*out)


def chair(rng: Rng) -> Shape:
    """A stacking chair with its back at y = 0."""
    shell = pick_material(rng, "plastic")
    return concat_shapes(
        corner_posts(0.44, 0.44, 0.44, 0.025, pick_material(rng, "galvanised"), rng),
        box_on((0, -0.22, 0.44), (0.44, 0.44, 0.03), shell, rng),
        *(
            box_on((x, -0.0125, 0.47), (0.025, 0.025, 0.2), pick_material(rng, "galvanised"), rng)
            for x in (-0.19, 0.19)
        ),
        box_on((0, -0.02, 0.6), (0.44, 0.03, 0.25), shell, rng),
    )


# Fire hoses and extinguishers.


def rolled_hose(rng: Rng, radius: float) -> Shape:
    """A rolled hose standing on its edge, its coupling in the middle; the roll's axis along y."""
    wide, skin, metal = 0.075, pick_material(rng, "hose"), pick_material(rng, "galvanised")
    out = [cylinder((0, -wide, radius), radius, wide, skin, skin, axis="y", sides=20, rng=rng)]
    out.append(cylinder((0, -wide - 0.02, radius), 0.035, 0.02, metal, metal, axis="y", sides=10, rng=rng))
    rings = np.arange(0.06, radius - 0.01, 0.045)
    for r in rings:  # windings
        out.append(
            cylinder((0, -wide - 0.006, radius), float(r), 0.006, skin, None, axis="y", sides=20, rng=rng)
        )
    return concat_shapes(*out)


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
    return concat_shapes(*out)


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
    return concat_shapes(*out, front_print(rng, -0.2, z + 0.36, 0.4, 0.2, "sign"))


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
    return concat_shapes(*out)


def extinguisher(rng: Rng) -> Shape:
    """A fire extinguisher on its bracket, with its sign above."""
    red, metal = Material("lacquer", 1, gray=75), pick_material(rng, "galvanised")
    return concat_shapes(
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
    )
