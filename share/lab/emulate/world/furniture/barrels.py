"""Drums and bins."""

from __future__ import annotations

from share.lab.emulate.world.furniture.parts import front_print, pick_material
from share.lab.emulate.world.mesh import Rng, Shape, concat_shapes, cylinder

RADIUS, HEIGHT = 0.29, 0.88  # m; a drum of 200 l


def drum(rng: Rng) -> Shape:
    """A steel drum with two swages and a rim; some carry a label."""
    skin, lid = pick_material(rng, "steel"), pick_material(rng, "steel")
    y = -RADIUS
    out = [cylinder((0, y, 0), RADIUS - 0.01, HEIGHT - 0.02, skin, lid, sides=18, rng=rng)]
    for z in (0.0, 0.29, 0.57, HEIGHT - 0.03):
        out.append(cylinder((0, y, z), RADIUS, 0.03, skin, None, sides=18, rng=rng))
    if rng.random() < 0.7:
        out.append(front_print(rng, -0.09, 0.36, 0.18, 0.16, "label", -2 * RADIUS))
    return concat_shapes(out)


def drum_row(rng: Rng, count: int) -> Shape:
    """Drums in a row."""
    pitch = 2 * RADIUS + 0.03
    return concat_shapes([drum(rng).placed_at((k - (count - 1) / 2) * pitch, 0) for k in range(count)])


def waste_bin(rng: Rng) -> Shape:
    """A waste bin, wider at the top, open."""
    skin = pick_material(rng, "plastic")
    hull = cylinder((0, -0.22, 0), 0.17, 0.6, skin, None, rng=rng, top=0.21)
    rim = cylinder((0, -0.22, 0.57), 0.22, 0.03, skin, None, rng=rng)
    floor = cylinder((0, -0.22, 0.02), 0.155, 0.3, skin, pick_material(rng, "fabric"), rng=rng, top=0.175)
    return concat_shapes([hull, rim, floor])
