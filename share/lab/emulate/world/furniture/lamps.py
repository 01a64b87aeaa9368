"""Lamps: the object and its light."""

from __future__ import annotations

from share.lab.emulate.world.furniture.parts import box_on, pick_material
from share.lab.emulate.world.layout import Light
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, concat_shapes, cylinder

_LAMP_MATERIAL = Material("lamp")
_LIGHT_OFFSET_M = 0.02  # the light starts below its lamp


def tube_lamp(rng: Rng, length: float, drop: float) -> Shape:
    """A fluorescent batten along x under a ceiling at z = 0: hung `drop` m below it by two wires."""
    body, wire = pick_material(rng, "steel"), pick_material(rng, "galvanised")
    z = -drop - 0.1
    out = [
        box_on((0, 0, z + 0.03), (length, 0.16, 0.07), body, rng),
        box_on((0, 0, z), (length - 0.06, 0.1, 0.03), _LAMP_MATERIAL, rng),
    ]
    if drop > 0.02:
        out += [box_on((x * length * 0.4, 0, z + 0.1), (0.008, 0.008, drop), wire, rng) for x in (-1, 1)]
    return concat_shapes(out)


def tube_light(
    x: float, y: float, ceiling: float, length: float, drop: float, power: float, along_y: bool
) -> Light:
    """Return the light of `tube_lamp` at (x, y) under `ceiling` m; `along_y`: it runs along y."""
    size = (0.1, length) if along_y else (length, 0.1)
    return Light((x, y, ceiling - drop - 0.1 - _LIGHT_OFFSET_M), power, size)


def high_bay_lamp(rng: Rng, drop: float) -> Shape:
    """A high-bay lamp under a ceiling at z = 0: a dish on a rod of `drop` m."""
    skin, z = pick_material(rng, "steel"), -drop - 0.35
    return concat_shapes(
        [
            cylinder((0, 0, z), 0.24, 0.22, skin, None, sides=18, rng=rng, top=0.08),
            cylinder((0, 0, z + 0.22), 0.08, 0.13, skin, skin, sides=12, rng=rng),
            cylinder((0, 0, z + 0.01), 0.22, 0.01, _LAMP_MATERIAL, _LAMP_MATERIAL, sides=18, rng=rng),
            box_on((0, 0, z + 0.35), (0.02, 0.02, drop), skin, rng),
        ]
    )


def high_bay_light(x: float, y: float, ceiling: float, drop: float, power: float) -> Light:
    """Return the light of `high_bay_lamp` at (x, y) under `ceiling` m."""
    return Light((x, y, ceiling - drop - 0.35 - _LIGHT_OFFSET_M), power, (0.4, 0.4))
