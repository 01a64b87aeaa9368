"""Pipes, ducts and trays along walls and under the ceiling."""

from __future__ import annotations

from share.lab.emulate.world.furniture.parts import box_on, pick_material
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, concat_shapes, cylinder


def pipe_run(rng: Rng, length: float, count: int) -> Shape:
    """Parallel pipes along x with flanges, and brackets that hold them from above (their top, z = 0.45,
    touches the ceiling)."""
    out, y = [], 0.0
    for _ in range(count):
        r = float(rng.uniform(0.03, 0.08))
        y -= r + 0.02
        skin = pick_material(rng, str(rng.choice(["steel", "galvanised"])))
        out.append(cylinder((-length / 2, y, 0.06 + r), r, length, skin, skin, axis="x", sides=12, rng=rng))
        for x in rng.uniform(-length / 2, length / 2, max(1, int(length / 2.5))):
            out.append(
                cylinder(
                    (float(x) * 0.9, y, 0.06 + r), r * 1.3, 0.05, skin, skin, axis="x", sides=12, rng=rng
                )
            )
        y -= r + 0.04
    steel = pick_material(rng, "galvanised")
    for k in range(max(2, round(length / 1.8))):
        x = ((k + 0.5) / max(2, round(length / 1.8)) - 0.5) * length
        out.append(box_on((x, y / 2, 0.03), (0.04, -y + 0.06, 0.03), steel, rng))
        out += [box_on((x, at, 0.06), (0.015, 0.015, 0.39), steel, rng) for at in (0.02, y - 0.02)]
    return concat_shapes(out)


def duct(rng: Rng, length: float) -> Shape:
    """A ventilation duct along x with flanges and outlets; its top, z = 0.5, touches the ceiling."""
    skin, w, h = pick_material(rng, "galvanised"), rng.uniform(0.35, 0.6), rng.uniform(0.25, 0.4)
    out = [box_on((0, -w / 2, 0.5 - h - 0.06), (length, w, h), skin, rng)]
    for k in range(int(length / 1.2) + 1):
        x = min(-length / 2 + 0.02 + 1.2 * k, length / 2 - 0.02)
        out.append(box_on((x, -w / 2, 0.5 - h - 0.08), (0.03, w + 0.04, h + 0.04), skin, rng))
        out.append(box_on((x, -w / 2, 0.46), (0.03, 0.05, 0.04), skin, rng))
    for x in rng.uniform(-length / 2.4, length / 2.4, max(1, int(length / 3))):
        out.append(box_on((float(x), -w / 2, 0.5 - h - 0.12), (0.4, 0.2, 0.06), Material("grating"), rng))
    return concat_shapes(out)


def wall_pipes(rng: Rng, height: float) -> Shape:
    """Pipes that run up a wall from the floor to `height`, with clips and a valve."""
    out, x = [], 0.0
    for _ in range(int(rng.integers(1, 4))):
        r, skin = float(rng.uniform(0.012, 0.04)), pick_material(rng, "steel")
        out.append(cylinder((x, -0.06, 0), r, height, skin, skin, sides=10, rng=rng))
        for z in (0.4, 1.5, 2.6):
            if z < height - 0.1:
                out.append(box_on((x, -0.05, z), (2 * r + 0.02, 0.1, 0.03), skin, rng))
        x += 2 * r + 0.05
    return concat_shapes(out)


def radiator(rng: Rng, width: float) -> Shape:
    """A sectional radiator on its brackets."""
    skin, count = Material("steel", 0, gray=190), max(4, round(width / 0.08))
    pitch = width / count
    fins = [
        box_on(((k + 0.5) * pitch - width / 2, -0.1, 0.14), (pitch - 0.02, 0.1, 0.56), skin, rng)
        for k in range(count)
    ]
    rails = [box_on((0, -0.1, z), (width, 0.05, 0.05), skin, rng) for z in (0.16, 0.62)]
    feet = [box_on((x * width / 2.5, -0.05, 0.1), (0.03, 0.1, 0.06), skin, rng) for x in (-1, 1)]
    stand = [box_on((x * width / 2.5, -0.1, 0), (0.03, 0.06, 0.14), skin, rng) for x in (-1, 1)]
    return concat_shapes([*fins, *rails, *feet, *stand])
