"""Trucks for pallets: a forklift and a hand pallet truck."""

from __future__ import annotations

from share.lab.emulate.world.furniture.parts import box_on, front_print, pick_material, strut
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, box, concat_shapes, cylinder, tube


def forklift(rng: Rng) -> Shape:
    """A counterbalance truck, 1.1 x 2.9 m, forks towards -y, overhead guard of 2.1 m."""
    paint, dark, bar = Material("lacquer", 1, gray=150), Material("rubber"), Material("steel", 0, gray=50)
    out = [
        box((-0.5, -1.75, 0.2), (0.5, -0.55, 0.62), paint, rng),
        box((-0.5, -0.55, 0.2), (0.5, 0, 1.05), paint, rng),
        box_on((0, -0.85, 0.62), (0.5, 0.45, 0.12), dark, rng),
        box_on((0, -0.64, 0.74), (0.46, 0.1, 0.5), dark, rng),
        box((-0.45, -1.75, 0.62), (0.45, -1.6, 1.0), paint, rng),
        strut((0, -1.6, 0.95), (0, -1.35, 1.1), 0.05, dark, rng),
        box((-0.5, -1.75, 2.05), (0.5, -0.3, 2.11), bar, rng),
        front_print(rng, -0.2, 0.4, 0.4, 0.2, "sign", 0.0).placed_at(0, 0, 0, 3.141592653589793),
    ]
    for x in (-0.46, 0.46):
        out.append(strut((x, -1.65, 1.0), (x, -1.45, 2.05), 0.05, bar, rng))
        out.append(strut((x, -0.35, 1.05), (x, -0.45, 2.05), 0.05, bar, rng))
        for y, r in ((-1.45, 0.3), (-0.35, 0.24)):
            hub, low = pick_material(rng, "galvanised"), x * 1.04 - 0.1
            out.append(cylinder((low, y, r), r, 0.2, dark, dark, axis="x", sides=18, rng=rng))
            out.append(cylinder((low - 0.01, y, r), 0.55 * r, 0.22, hub, hub, axis="x", sides=14, rng=rng))
        out.append(box_on((x * 0.7, -1.84, 0.06), (0.09, 0.12, 2.0), bar, rng))
        out.append(box_on((x * 0.55, -2.4, 0.05), (0.12, 0.98, 0.04), bar, rng))
    for z in (0.1, 0.45, 1.2, 1.95):
        out.append(box_on((0, -1.84, z), (0.55, 0.08, 0.1), bar, rng))
    return concat_shapes(out)


def pallet_truck(rng: Rng) -> Shape:
    """A hand pallet truck: two forks, a pump, a drawbar."""
    paint, dark = pick_material(rng, "lacquer"), Material("rubber")
    out = [box_on((x, -0.6, 0.05), (0.16, 1.15, 0.06), paint, rng) for x in (-0.19, 0.19)]
    out += [
        cylinder((x - 0.05, -1.05, 0.045), 0.04, 0.1, dark, dark, axis="x", sides=12, rng=rng)
        for x in (-0.19, 0.19)
    ]
    out.append(box((-0.24, -0.03, 0.05), (0.24, 0.12, 0.35), paint, rng))
    out += [
        cylinder((x - 0.03, 0.2, 0.09), 0.09, 0.06, dark, dark, axis="x", sides=14, rng=rng)
        for x in (-0.09, 0.09)
    ]
    out.append(cylinder((0, 0.18, 0.12), 0.05, 0.4, paint, paint, sides=12, rng=rng))
    out.append(tube([(0, 0.2, 0.5), (0, 0.28, 0.85), (0, 0.36, 1.15)], 0.02, paint, 8, rng))
    out.append(tube([(-0.15, 0.38, 1.2), (0, 0.36, 1.15), (0.15, 0.38, 1.2)], 0.015, dark, 8, rng))
    return concat_shapes(out).placed_at(0, -0.4)
