"""Tables, workbenches, benches and chairs."""

from __future__ import annotations

from share.lab.emulate.world.furniture.cartons import carton
from share.lab.emulate.world.furniture.parts import box_on, corner_posts, pick_material, pick_print
from share.lab.emulate.world.mesh import Rng, Shape, box, concat_shapes, cylinder, decal


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
    return concat_shapes(out)


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


def table(rng: Rng, width: float, depth: float = 0.8) -> Shape:
    """A plain table of 0.74 m with small objects on it."""
    top = 0.74
    out = [
        corner_posts(width, depth, top - 0.03, 0.05, pick_material(rng, "steel"), rng),
        box((-width / 2, -depth, top - 0.03), (width / 2, 0, top), pick_material(rng, "wood"), rng),
    ]
    return concat_shapes(
        out + [s.placed_at(0, -0.1, top) for s in _table_clutter(rng, width - 0.2, depth - 0.3)]
    )


def bench(rng: Rng, width: float) -> Shape:
    """A slatted bench of a changing room."""
    wood, metal = pick_material(rng, "wood"), pick_material(rng, "steel")
    out = [box_on((0, y, 0.42), (width, 0.09, 0.03), wood, rng) for y in (-0.06, -0.17, -0.28)]
    for x in (-width / 2 + 0.15, width / 2 - 0.15):
        out.append(box_on((x, -0.17, 0.38), (0.04, 0.32, 0.04), metal, rng))
        out += [box_on((x, y, 0), (0.04, 0.04, 0.38), metal, rng) for y in (-0.05, -0.29)]
    return concat_shapes(out)


def chair(rng: Rng) -> Shape:
    """A stacking chair with its back at y = 0."""
    shell = pick_material(rng, "plastic")
    return concat_shapes(
        [
            corner_posts(0.44, 0.44, 0.44, 0.025, pick_material(rng, "galvanised"), rng),
            box_on((0, -0.22, 0.44), (0.44, 0.44, 0.03), shell, rng),
            *(
                box_on((x, -0.0125, 0.47), (0.025, 0.025, 0.2), pick_material(rng, "galvanised"), rng)
                for x in (-0.19, 0.19)
            ),
            box_on((0, -0.02, 0.6), (0.44, 0.03, 0.25), shell, rng),
        ]
    )
