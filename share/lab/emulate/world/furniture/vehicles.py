"""Vehicles: a fire engine and a van (front towards -y, rear at y = 0); trucks for pallets."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.world.furniture.parts import box_on, front_print, pick_material, pick_print, strut
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import (
    Rng,
    Shape,
    box,
    concat_shapes,
    cylinder,
    decal,
    polygon,
    prism,
    quad,
    tube,
)

# Takes an outline (y, z), extruded along +z, to one extruded along x.
_UPRIGHT = np.array([(0, 0, 1, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1.0)])


def _body(outline: list[tuple[float, float]], half: float, skin: Material, rng: Rng) -> Shape:
    """A body of constant section: outline (y, z) m, counter-clockwise as seen from +x."""
    return prism(outline, -half, half, skin, skin, rng).transformed(_UPRIGHT)


def _wheel(x: float, y: float, radius: float, wide: float, rng: Rng) -> Shape:
    """A tyre, its rim and hub, which stand out to the side of x."""
    tyre, rim, out = Material("rubber"), pick_material(rng, "galvanised"), np.sign(x) * wide / 2
    discs = (
        (x - wide / 2, radius, wide, tyre, 22),
        (x + out - 0.015, 0.58 * radius, 0.03, rim, 14),
        (x + out - 0.03, 0.2 * radius, 0.06, rim, 10),
    )
    return concat_shapes(
        *[
            cylinder((left, y, radius), r, thick, skin, skin, axis="x", sides=sides, rng=rng)
            for left, r, thick, skin, sides in discs
        ]
    )


def _arch(x: float, y: float, radius: float) -> Shape:
    """The dark half disc above a wheel, on a side at x."""
    angle = np.linspace(0, np.pi, 9)
    high = radius * 1.12
    ring = np.column_stack([0 * angle, y + np.cos(angle) * high * 1.05, radius * 1.1 + np.sin(angle) * high])
    if x < 0:
        ring = ring[::-1]
    return polygon(ring + np.array([x + np.sign(x) * 0.004, 0, 0]), Material("rubber"))


def _window_pane(
    x: float, y: float, z: float, wide: float, high: float, rng: Rng, kind: str = "glass"
) -> Shape:
    """A pane or plate on a side at x, from y - wide/2 to y + wide/2, from z up."""
    along = np.array([0, np.sign(x) * wide, 0])
    skin = Material(kind) if kind == "glass" else pick_print(rng, kind)[0]
    return decal(np.array([x, y, z]) - along / 2, along, (0, 0, high), skin, rng, offset=0.006)


def _lights(half: float, y: float, z: float, rng: Rng) -> list[Shape]:
    """Head lamps, grille, bumper and plate of a front in the plane y."""
    glass, skin = Material("plastic", 1, gray=215), Material("rubber")
    out = [box_on((x * (half - 0.22), y - 0.015, z), (0.3, 0.03, 0.18), glass, rng) for x in (-1, 1)]
    grille = (-half + 0.45, y - 0.006, z - 0.05)
    out.append(quad(grille, (2 * half - 0.9, 0, 0), (0, 0, 0.3), Material("grating"), rng))
    out.append(box_on((0, y - 0.03, z - 0.32), (2 * half - 0.06, 0.1, 0.22), skin, rng))
    plate, cell = pick_print(rng, "sign")
    out.append(decal((-0.26, y - 0.08, z - 0.27), (0.52, 0, 0), (0, 0, 0.11), plate, rng, cell))
    return out


def fire_engine(rng: Rng, length: float, width: float = 2.3) -> Shape:
    """A fire engine: crew cab with windows and light bar, shuttered lockers, a ladder and
    a hose reel on its roof, a stripe along its sides."""
    half, top, cab = width / 2 - 0.03, 2.45, 0.36 * length
    paint, white = Material("lacquer", 0, gray=72), Material("marking", 1, gray=195)
    nose = -length + 0.1
    front_ = [(nose, 0.45), (nose + cab, 0.45), (nose + cab, top), (nose + 0.35, top), (nose, 1.35)]
    out = [
        _body(front_, half, paint, rng),
        box((-half, nose + cab + 0.06, 0.5), (half, -0.05, top + 0.12), paint, rng),
        box_on((0, -length / 2, 0.32), (0.9, length - 0.5, 0.2), Material("rubber"), rng),
        box_on((0, -0.025, 0.4), (width - 0.2, 0.05, 0.18), Material("stripes"), rng),
    ]
    slope = np.array([0, 0.35, top - 1.35])
    lean = np.array([-half + 0.1, nose, 1.35]) + 0.1 * slope
    out.append(decal(lean, (2 * half - 0.2, 0, 0), 0.78 * slope, Material("glass"), rng, offset=0.008))
    radius = 0.46
    for x in (-half, half):
        out += [_arch(x, y, radius) for y in (nose + 0.85, -1.05)]
        out += [_wheel(x - np.sign(x) * 0.13, y, radius, 0.28, rng) for y in (nose + 0.85, -1.05)]
        out += [_window_pane(x, nose + c, 1.4, 0.75, 0.75, rng) for c in (0.85, cab - 0.55)]
        handle = (x + np.sign(x) * 0.04, nose + 1.4, 1.2)
        out.append(box_on(handle, (0.06, 0.16, 0.03), pick_material(rng, "galvanised"), rng))
        wide = (length - cab - 0.4) / 3
        for k in range(3):
            y, low = nose + cab + 0.2 + (k + 0.5) * wide, (1.1 if k == 2 else 0.65)
            out.append(_window_pane(x, y, low, wide - 0.1, top - 0.15 - low, rng, "shutter"))
        stripe = np.sign(x) * (cab - 0.1)
        start = nose + (0.05 if x > 0 else cab - 0.05)
        out.append(decal((x, start, 1.08), (0, stripe, 0), (0, 0, 0.16), white, rng, offset=0.008))
        rail = (x * 0.85, -length * 0.3, top + 0.12)
        out.append(box_on(rail, (0.06, length * 0.5, 0.14), pick_material(rng, "galvanised"), rng))
        out.append(box_on((x * 1.06, nose + 0.3, 1.5), (0.12, 0.06, 0.42), Material("rubber"), rng))
    out += _lights(half, nose, 0.95, rng)
    out.append(box_on((0, nose + 0.6, top), (1.5, 0.25, 0.16), Material("plastic", 2, gray=60), rng))
    out += _roof_ladder(rng, length * 0.56, -0.2, top + 0.2)
    out += _rear_parts(rng, half, top)
    return concat_shapes(*out)


def _roof_ladder(rng: Rng, length: float, rear: float, z: float) -> list[Shape]:
    skin = pick_material(rng, "galvanised")
    out = [strut((x, rear, z), (x, rear - length, z), 0.06, skin, rng) for x in (-0.25, 0.25)]
    count = int(length / 0.3)
    rungs = [rear - (k + 0.5) * length / count for k in range(count)]
    out += [strut((-0.22, y, z), (0.22, y, z), 0.03, skin, rng) for y in rungs]
    feet = [(x, rear - s * length) for x in (-0.25, 0.25) for s in (0.1, 0.9)]
    return out + [box_on((x, y, z - 0.08), (0.05, 0.08, 0.05), skin, rng) for x, y in feet]


def _rear_parts(rng: Rng, half: float, top: float) -> list[Shape]:
    """The shutter of the pump, its lamps, and the sign of the service."""
    wide = 2 * half - 0.7
    skin, cell = pick_print(rng, "shutter")
    out = [decal((wide / 2, -0.05, 0.9), (-wide, 0, 0), (0, 0, top - 1.1), skin, rng, cell, offset=0.006)]
    lamp = Material("plastic", 2, gray=60)
    return out + [box_on((x * (half - 0.16), -0.035, 0.8), (0.16, 0.03, 0.4), lamp, rng) for x in (-1, 1)]


def van(rng: Rng, length: float) -> Shape:
    """A panel van of 1.9 m width and height."""
    half, top, nose = 0.92, 1.95, -length + 0.1
    paint = Material("lacquer", 1, gray=float(rng.choice([70, 110, 190])))
    # starts at the rear, from where all corners are visible, as the fan of triangles needs
    rear, front = [(-0.05, 0.32), (-0.05, top), (nose + 1.25, top)], [(nose + 0.75, 1.1), (nose, 0.92)]
    out = [_body([*rear, *front, (nose, 0.32)], half, paint, rng)]
    slope = np.array([0, 0.5, top - 1.1])
    low = np.array([-half + 0.1, nose + 0.75, 1.1]) + 0.08 * slope
    out.append(decal(low, (2 * half - 0.2, 0, 0), 0.82 * slope, Material("glass"), rng, offset=0.008))
    for x in (-half, half):
        out += [_arch(x, y, 0.33) for y in (nose + 0.75, -0.85)]
        out += [_wheel(x - np.sign(x) * 0.09, y, 0.33, 0.2, rng) for y in (nose + 0.75, -0.85)]
        out.append(_window_pane(x, nose + 1.6, 1.12, 0.75, 0.55, rng))
        seam = np.sign(x) * (length - 2.4)
        start = nose + 2.1 if x > 0 else -0.2
        out.append(decal((x, start, 0.85), (0, seam, 0), (0, 0, 0.3), *_stripe(rng), offset=0.006))
        handle = (x + np.sign(x) * 0.03, nose + 1.9, 0.98)
        out.append(box_on(handle, (0.05, 0.14, 0.03), Material("rubber"), rng))
        out.append(box_on((x * 1.08, nose + 1.22, 1.12), (0.14, 0.08, 0.2), Material("rubber"), rng))
    out += _lights(half, nose, 0.66, rng)
    lamp = Material("plastic", 2, gray=60)
    out += [box_on((x * (half - 0.1), -0.035, 0.75), (0.12, 0.03, 0.45), lamp, rng) for x in (-1, 1)]
    out += [
        decal((x + 0.36, -0.05, 1.15), (-0.72, 0, 0), (0, 0, 0.6), Material("glass"), rng, offset=0.006)
        for x in (-0.42, 0.42)
    ]
    out.append(box_on((0, -0.03, 0.32), (2 * half - 0.1, 0.06, 0.18), Material("rubber"), rng))
    return concat_shapes(*out)


def _stripe(rng: Rng) -> tuple[Material, Rng, int]:
    skin, cell = pick_print(rng, "sign")
    return skin, rng, cell


# Trucks for pallets.


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
    return concat_shapes(*out)


def pallet_truck(rng: Rng) -> Shape:
    """A hand pallet truck: two forks, a pump, a drawbar."""
    paint, dark = pick_material(rng, "lacquer"), Material("rubber")
    out = [box_on((x, -0.6, 0.05), (0.16, 1.15, 0.06), paint, rng) for x in (-0.19, 0.19)]
    for x in (-0.19, 0.19):
        out.append(cylinder((x - 0.05, -1.05, 0.045), 0.04, 0.1, dark, dark, axis="x", sides=12, rng=rng))
    out.append(box((-0.24, -0.03, 0.05), (0.24, 0.12, 0.35), paint, rng))
    for x in (-0.09, 0.09):
        out.append(cylinder((x - 0.03, 0.2, 0.09), 0.09, 0.06, dark, dark, axis="x", sides=14, rng=rng))
    out.append(cylinder((0, 0.18, 0.12), 0.05, 0.4, paint, paint, sides=12, rng=rng))
    out.append(tube([(0, 0.2, 0.5), (0, 0.28, 0.85), (0, 0.36, 1.15)], 0.02, paint, 8, rng))
    out.append(tube([(-0.15, 0.38, 1.2), (0, 0.36, 1.15), (0.15, 0.38, 1.2)], 0.015, dark, 8, rng))
    return concat_shapes(*out).placed_at(0, -0.4)
