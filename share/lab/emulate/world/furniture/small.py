"""Small objects on the floor: cones, buckets, tool boxes, hand trucks."""

from __future__ import annotations

from share.lab.emulate.world.furniture.parts import box_on, front_print, pick_material, strut
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, box, concat_shapes, cylinder, tube


def cone(rng: Rng) -> Shape:
    """A traffic cone of 0.5 m with a white collar."""
    skin, white = Material("plastic", 0, gray=120), Material("marking")
    return concat_shapes(
        [
            box_on((0, -0.15, 0), (0.3, 0.3, 0.03), Material("rubber"), rng),
            cylinder((0, -0.15, 0.03), 0.115, 0.47, skin, skin, sides=16, rng=rng, top=0.025),
            cylinder((0, -0.15, 0.22), 0.083, 0.12, white, None, sides=16, rng=rng, top=0.059),
        ]
    )


def cones(rng: Rng) -> Shape:
    """Two or three cones in a row."""
    count = int(rng.integers(2, 4))
    return concat_shapes([cone(rng).placed_at((k - (count - 1) / 2) * 0.36, 0) for k in range(count)])


def bucket(rng: Rng) -> Shape:
    skin = pick_material(rng, "plastic")
    return concat_shapes(
        [
            cylinder((0, -0.16, 0), 0.11, 0.27, skin, None, sides=14, rng=rng, top=0.145),
            cylinder((0, -0.16, 0.005), 0.1, 0.12, skin, skin, sides=14, rng=rng),
            cylinder((0, -0.16, 0.255), 0.155, 0.015, skin, None, sides=14, rng=rng),
        ]
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
    return concat_shapes([*out, front_print(rng, -0.3, 0.55 - 0.3, 0.12, 0.1, "label", -0.465)])


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
    return concat_shapes(out)


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
    return concat_shapes(out)
