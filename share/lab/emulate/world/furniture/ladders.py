"""Ladders: against a wall, a step ladder, a rolling platform."""

from __future__ import annotations

from share.lab.emulate.world.furniture.parts import box_on, pick_material, strut
from share.lab.emulate.world.mesh import Rng, Shape, concat_shapes


def leaning_ladder(rng: Rng, length: float) -> Shape:
    """A ladder of `length` m that leans against a wall in the plane y = 0, its feet 0.3 of that away."""
    skin, foot = pick_material(rng, "galvanised"), -0.28 * length
    top = (length**2 - foot**2) ** 0.5
    out = [strut((x, foot, 0.02), (x, -0.04, top), 0.03, skin, rng, 0.06) for x in (-0.2, 0.2)]
    for k in range(1, int(length / 0.28)):
        s = k * 0.28 / length
        y, z = foot + (-0.04 - foot) * s, 0.02 + (top - 0.02) * s
        out.append(strut((-0.17, y, z), (0.17, y, z), 0.03, skin, rng))
    return concat_shapes(out)


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
    return concat_shapes(out)
