"""A bare room with white walls, almost without features."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.world.furniture import building, equipment
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.scenes import fill
from share.lab.emulate.world.scenes.layout_builder import (
    LayoutBuilder,
    Size,
    add_skirting,
    build_enclosure,
    outer_walls,
)


def whitewall(seed: int, size: Size) -> Layout:
    """A door, a radiator, a table with chairs, one or two small objects on the walls."""
    rng = np.random.default_rng([seed, 13])
    plan = LayoutBuilder("whitewall", seed, size, rng)
    walls = outer_walls(size)
    white, floor = Material("paint", 0, gray=180), Material("carpet", 0, contrast=0.25, gray=120)
    build_enclosure(plan, [(size[2], white)], floor, Material("paint", 1, gray=185))
    add_skirting(plan, walls)
    order = rng.permutation(4)
    door_at = rng.uniform(1, walls[order[0]].length - 1)
    fill.place_centred(plan, walls[order[0]], "door", building.door(rng), door_at, 1.2)
    fill.place_on_wall(plan, walls[order[1]], "radiator", building.radiator(rng, 1.2), rng.uniform(0.5, 3))
    fill.place_on_wall(plan, walls[order[2]], "bench", equipment.bench(rng, 1.4), rng.uniform(0.5, 3))
    fill.place_on_wall(plan, walls[order[3]], "bucket", equipment.bucket(rng), rng.uniform(0.5, 3))
    x, y = size[0] / 2 + rng.uniform(-0.5, 0.5), size[1] / 2 + rng.uniform(-0.2, 0.2)
    plan.add_if_free("table", equipment.table(rng, rng.uniform(1.2, 1.6)).placed_at(x, y + 0.4))
    plan.add_if_free("chair", equipment.chair(rng).placed_at(x + rng.uniform(-0.3, 0.3), y - 0.95, 0, np.pi))
    for wall in walls:
        fill.hang_on_wall(
            plan,
            wall,
            {"notice": (1, building.notice), "sign": (1, building.sign)},
            int(rng.integers(0, 2)),
            1.9,
        )
    xs, ys = [size[0] * f for f in (0.25, 0.75)], [size[1] * f for f in (0.3, 0.7)]
    fill.light_tubes(plan, xs, ys, 1.5, 0.0)
    return plan.to_layout(ambient=0.4)
