"""Drums and bins that stand about."""

from __future__ import annotations

from share.lab.emulate.world.furniture.parts import front, pick
from share.lab.emulate.world.mesh import Rng, Shape, concat, cylinder

RADIUS, HEIGHT = 0.29, 0.88  # m; a drum of 200 l


def drum(rng: Rng) -> Shape:
    """A steel drum with two swages and a rim; some carry a label."""
    skin, lid = pick(rng, "steel"), pick(rng, "steel")
    y = -RADIUS
    out = [cylinder((0, y, 0), RADIUS - 0.01, HEIGHT - 0.02, skin, lid, sides=18, rng=rng)]
    for z in (0.0, 0.29, 0.57, HEIGHT - 0.03):
        out.append(cylinder((0, y, z), RADIUS, 0.03, skin, None, sides=18, rng=rng))
    if rng.random() < 0.7:
        out.append(front(rng, -0.09, 0.36, 0.18, 0.16, "label", -2 * RADIUS))
    return concat(out)


def drums(rng: Rng, count: int) -> Shape:
    """Drums side by side."""
    pitch = 2 * RADIUS + 0.03
    return concat([drum(rng).at((k - (count - 1) / 2) * pitch, 0) for k in range(count)])


def bin_(rng: Rng) -> Shape:
    """A waste bin, wider at the top, open."""
    skin = pick(rng, "plastic")
    hull = cylinder((0, -0.22, 0), 0.17, 0.6, skin, None, rng=rng, top=0.21)
    rim = cylinder((0, -0.22, 0.57), 0.22, 0.03, skin, None, rng=rng)
    floor = cylinder((0, -0.22, 0.02), 0.155, 0.3, skin, pick(rng, "fabric"), rng=rng, top=0.175)
    return concat([hull, rim, floor])
