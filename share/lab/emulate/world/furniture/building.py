"""Parts of the building: doors and windows, pillars and girders, pipes and ducts, lamps, signs on walls."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.world.furniture.parts import box_on, front_print, pick_material, pick_print
from share.lab.emulate.world.layout import Light
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, box, concat_shapes, cylinder, quad


def _frame(rng: Rng, width: float, low: float, high: float, skin: Material, bar: float = 0.07) -> list[Shape]:
    """Posts and lintel around an opening; a sill too where it does not reach the floor."""
    deep = 0.06
    out = [
        box_on((x * (width + bar) / 2, -deep / 2, low), (bar, deep, high - low), skin, rng) for x in (-1, 1)
    ]
    out.append(box_on((0, -deep / 2, high), (width + 2 * bar, deep, bar), skin, rng))
    if low > 0:
        out.append(box_on((0, -deep, low - 0.04), (width + 2 * bar, 2 * deep, 0.04), skin, rng))
    return out


def _door_leaf(rng: Rng, width: float, low: float, high: float, kind: str) -> Shape:
    skin, cell = pick_print(rng, kind)
    return quad((-width / 2, -0.02, low), (width, 0, 0), (0, 0, high - low), skin, rng, cell)


def door(rng: Rng) -> Shape:
    """A door of 0.9 x 2.05 m in its frame, with a handle and a lit sign above."""
    skin = pick_material(rng, "steel")
    sign, cell = pick_print(rng, "sign")
    return concat_shapes(
        *_frame(rng, 0.9, 0, 2.05, skin),
        _door_leaf(rng, 0.9, 0, 2.05, "door"),
        box_on((0.37, -0.05, 1.0), (0.13, 0.03, 0.025), pick_material(rng, "galvanised"), rng),
        box((-0.2, -0.05, 2.2), (0.2, 0, 2.4), {"-y": sign, "all": skin}, rng, cell),
    )


def roller_door(rng: Rng, width: float, height: float) -> Shape:
    """A closed roller door: slats that stand out, guide rails, the box of its drum above."""
    rail, slat = pick_material(rng, "galvanised"), Material("corrugated", 1)
    top = height + 0.4
    out = _frame(rng, width, 0, height, rail, 0.12)[:2]
    out.append(_door_leaf(rng, width, 0, height, "shutter"))
    out.append(box((-width / 2 - 0.12, -0.38, height), (width / 2 + 0.12, 0, top), slat, rng))
    out.append(box_on((0, -0.03, 0), (width, 0.05, 0.1), Material("rubber"), rng))
    out.append(cylinder((width / 2 + 0.12, -0.2, height + 0.2), 0.1, 0.2, rail, rail, axis="x", rng=rng))
    return concat_shapes(*out)


def window(rng: Rng, width: float, height: float) -> Shape:
    """A window with its frame and sill; its lower edge is at z = 0."""
    return concat_shapes(
        *_frame(rng, width, 0.04, height, pick_material(rng, "steel"), 0.06),
        _door_leaf(rng, width, 0.04, height, "window"),
    )


# Pillars and girders.


def concrete_pillar(rng: Rng, side: float, height: float) -> Shape:
    """A square pillar with its corners guarded by striped angles up to 1.2 m, and notices on it. Its
    middle is at the origin."""
    half, guard = side / 2, Material("stripes")
    out = [box_on((0, 0, 0), (side, side, height), pick_material(rng, "concrete"), rng)]
    for x in (-1, 1):
        for y in (-1, 1):
            low = np.array([x * half - 0.05 * (x > 0), y * half - 0.05 * (y > 0), 0.02])
            low += 0.008 * np.array([x, y, 0])
            out.append(box(low, low + np.array([0.05, 0.05, 1.2]), guard, rng))
    for turn in range(4):
        if rng.random() < 0.6:
            out.append(_notice(rng, half).placed_at(0, 0, 0, turn * np.pi / 2))
    return concat_shapes(*out)


def _notice(rng: Rng, half: float) -> Shape:
    w = rng.uniform(0.15, 0.25)
    kind = str(rng.choice(["sign", "notice", "label"]))
    return front_print(rng, -w / 2, rng.uniform(1.35, 1.8), w, w * rng.uniform(0.8, 1.4), kind, -half)


def steel_pillar(rng: Rng, side: float, height: float) -> Shape:
    """An H-section on a foot plate. Its middle is at the origin."""
    skin, t = pick_material(rng, "steel"), 0.02
    out = [box_on((0, y * (side - t) / 2, 0), (side, t, height), skin, rng) for y in (-1, 1)]
    out.append(box_on((0, 0, 0), (t, side - 2 * t, height), skin, rng))
    out.append(box_on((0, 0, 0), (side + 0.12, side + 0.12, 0.015), skin, rng))
    bolts = (side + 0.06) / 2
    out += [
        box_on((x * bolts, y * bolts, 0.015), (0.03, 0.03, 0.03), skin, rng) for x in (-1, 1) for y in (-1, 1)
    ]
    if rng.random() < 0.7:
        out.append(front_print(rng, -side * 0.4, 1.5, side * 0.8, side, "sign", -side / 2))
    return concat_shapes(*out)


def girder(rng: Rng, length: float, height: float) -> Shape:
    """An I-beam along x; its top flange, z = `height`, touches the ceiling."""
    skin, t, w = pick_material(rng, "steel"), 0.018, 0.6 * height
    out = [box_on((0, 0, z), (length, w, t), skin, rng) for z in (0.0, height - t)]
    out.append(box_on((0, 0, t), (length, 0.014, height - 2 * t), skin, rng))
    for k in range(1, int(length / 1.5) + 1):
        x = min(k * 1.5, length - 0.1) - length / 2
        out.append(box_on((x, 0, t), (0.012, w * 0.9, height - 2 * t), skin, rng))
    return concat_shapes(*out)


# Pipes, ducts and radiators.


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
    return concat_shapes(*out)


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
    return concat_shapes(*out)


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
    return concat_shapes(*out)


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
    return concat_shapes(*fins, *rails, *feet, *stand)


# Lamps: the object and its light.

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
    return concat_shapes(*out)


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
        cylinder((0, 0, z), 0.24, 0.22, skin, None, sides=18, rng=rng, top=0.08),
        cylinder((0, 0, z + 0.22), 0.08, 0.13, skin, skin, sides=12, rng=rng),
        cylinder((0, 0, z + 0.01), 0.22, 0.01, _LAMP_MATERIAL, _LAMP_MATERIAL, sides=18, rng=rng),
        box_on((0, 0, z + 0.35), (0.02, 0.02, drop), skin, rng),
    )


def high_bay_light(x: float, y: float, ceiling: float, drop: float, power: float) -> Light:
    """Return the light of `high_bay_lamp` at (x, y) under `ceiling` m."""
    return Light((x, y, ceiling - drop - 0.35 - _LIGHT_OFFSET_M), power, (0.4, 0.4))


# Signs, posters and panels on walls.


def printed_plate(rng: Rng, kind: str, width: float, height: float, thick: float = 0.012) -> Shape:
    """A thin plate with a print of this kind on its front; its lower edge is at z = 0."""
    skin, cell = pick_print(rng, kind)
    edge = pick_material(rng, "steel")
    skins = {"-y": skin, "+y": None, "all": edge}
    return box((-width / 2, -thick, 0), (width / 2, 0, height), skins, rng, cell)


def sign(rng: Rng) -> Shape:
    w = rng.uniform(0.25, 0.7)
    return printed_plate(rng, "sign", w, w * rng.uniform(0.6, 1.2))


def poster(rng: Rng) -> Shape:
    w = rng.uniform(0.4, 0.95)
    return printed_plate(rng, "poster", w, w * rng.uniform(0.75, 1.4))


def notice(rng: Rng) -> Shape:
    """A sheet of A4 or A3 in a frame."""
    w = float(rng.choice([0.21, 0.297, 0.42]))
    return printed_plate(rng, "notice", w, w * 1.414, 0.005)


def pin_board(rng: Rng) -> Shape:
    return printed_plate(rng, "board", rng.uniform(0.9, 1.6), rng.uniform(0.7, 1.0), 0.025)


def tool_wall(rng: Rng) -> Shape:
    return printed_plate(rng, "tools", rng.uniform(1.0, 1.8), rng.uniform(0.8, 1.1), 0.03)


def fuse_box(rng: Rng) -> Shape:
    return printed_plate(rng, "gauge", rng.uniform(0.3, 0.6), rng.uniform(0.4, 0.8), 0.14)
