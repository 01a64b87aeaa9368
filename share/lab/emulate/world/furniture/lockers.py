"""Lockers and cloakrooms."""

from __future__ import annotations

from share.lab.emulate.world.furniture.parts import box_on, pick_material, pick_print
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, box, concat_shapes, quad

_WIDTH, _DEPTH, _HEIGHT = 0.4, 0.48, 1.85


def lockers(rng: Rng, count: int) -> Shape:
    """A row of steel lockers on a plinth, each door with its vents, lock and number."""
    skin, width = pick_material(rng, "steel"), count * _WIDTH
    out = [
        box_on((0, -_DEPTH / 2 - 0.01, 0), (width - 0.04, _DEPTH - 0.06, 0.08), Material("rubber"), rng),
        box((-width / 2, -_DEPTH, 0.08), (width / 2, 0, _HEIGHT), {"all": skin, "+y": None}, rng),
    ]
    print_, cell = pick_print(rng, "locker")
    for k in range(count):
        x = -width / 2 + k * _WIDTH + 0.008
        out.append(
            quad((x, -_DEPTH - 0.012, 0.1), (_WIDTH - 0.016, 0, 0), (0, 0, _HEIGHT - 0.12), print_, rng, cell)
        )
        out.append(
            box_on((x + 0.33, -_DEPTH - 0.02, 1.0), (0.02, 0.02, 0.09), pick_material(rng, "galvanised"), rng)
        )
    return concat_shapes(out)


def cloakroom(rng: Rng, count: int) -> Shape:
    """Places for turnout gear: dividers, a shelf with helmets, jackets on hooks, boots below."""
    skin, pitch, d = pick_material(rng, "steel"), 0.5, 0.42
    width = count * pitch
    out = [box_on(((k - count / 2) * pitch, -d / 2, 0), (0.02, d, 1.9), skin, rng) for k in range(count + 1)]
    out += [box((-width / 2 + 0.01, -d, z), (width / 2 - 0.01, 0, z + 0.02), skin, rng) for z in (0.3, 1.6)]
    for k in range(count):
        out += _turnout_gear(rng, (k + 0.5 - count / 2) * pitch)
    return concat_shapes(out)


def _turnout_gear(rng: Rng, x: float) -> list[Shape]:
    coat, out = pick_material(rng, "fabric"), []
    if rng.random() < 0.85:
        low = rng.uniform(0.62, 0.8)
        out.append(box_on((x, -0.2, low), (0.34, 0.14, 1.48 - low), coat, rng))
        out += [box_on((x + s * 0.2, -0.2, low + 0.1), (0.05, 0.1, 1.28 - low), coat, rng) for s in (-1, 1)]
        band = Material("marking")
        out.append(box_on((x, -0.2, low + 0.12), (0.35, 0.15, 0.05), band, rng))
        out.append(box_on((x, -0.2, 1.48), (0.015, 0.015, 0.12), pick_material(rng, "galvanised"), rng))
    if rng.random() < 0.8:
        helmet = pick_material(rng, "plastic")
        out.append(box_on((x, -0.22, 1.62), (0.26, 0.3, 0.04), helmet, rng))
        out.append(box_on((x, -0.21, 1.66), (0.2, 0.22, 0.11), helmet, rng))
    if rng.random() < 0.7:
        boots = Material("rubber")
        out += [box_on((x + s * 0.08, -0.22, 0.0), (0.1, 0.26, 0.1), boots, rng) for s in (-1, 1)]
        out += [box_on((x + s * 0.08, -0.16, 0.1), (0.1, 0.12, 0.16), boots, rng) for s in (-1, 1)]
    return out
