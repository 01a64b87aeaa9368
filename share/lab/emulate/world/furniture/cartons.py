"""Cartons: one, a stack on the floor, a row on a shelf."""

from __future__ import annotations

from share.lab.emulate.world.furniture.parts import pick_material, pick_print
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, box, concat_shapes, decal

_TAPE = Material("plastic", 9, gray=165, contrast=0.5)


def carton(rng: Rng, width: float, depth: float, height: float) -> Shape:
    """A closed carton, taped along its top; most have a label on the front or an end."""
    skin = pick_material(rng, "cardboard")
    out = [box((-width / 2, -depth, 0), (width / 2, 0, height), {"all": skin, "bottom": None}, rng)]
    tape = 0.05
    out.append(decal((-width / 2, -depth / 2 - tape / 2, height), (width, 0, 0), (0, tape, 0), _TAPE, rng))
    if rng.random() < 0.5:
        drop = min(0.08, height / 3)
        corner = (width / 2, -depth / 2 - tape / 2, height - drop)
        out.append(decal(corner, (0, tape, 0), (0, 0, drop), _TAPE, rng))
    if rng.random() < 0.6:
        out.append(_label(rng, width, depth, height))
    return concat_shapes(out)


def _label(rng: Rng, width: float, depth: float, height: float) -> Shape:
    wide = min(rng.uniform(0.08, 0.2), 0.8 * width)
    tall = min(wide * rng.uniform(0.6, 1.2), 0.7 * height)
    x = rng.uniform(-width / 2 + 0.01, width / 2 - wide - 0.01)
    z = rng.uniform(0.05, 0.95) * (height - tall)
    skin, cell = pick_print(rng, "label")
    return decal((x, -depth, z), (wide, 0, 0), (0, 0, tall), skin, rng, cell)


def carton_stack(rng: Rng, width: float, depth: float, height: float) -> Shape:
    """Columns of cartons side by side on the floor, each carton smaller than the one below it."""
    out, x = [], 0.0
    while x < width - 0.25:
        w = min(rng.uniform(0.3, 0.65), width - x)
        out += _carton_column(rng, x - width / 2 + w / 2, w - 0.01, depth, height * rng.uniform(0.35, 1))
        x += w + rng.uniform(0.01, 0.05)
    return concat_shapes(out)


def _carton_column(rng: Rng, x: float, width: float, depth: float, height: float) -> list[Shape]:
    out: list[Shape] = []
    z, w, d = 0.0, width, depth * rng.uniform(0.75, 1)
    while not out or z + 0.2 < height:
        h = min(rng.uniform(0.2, 0.5), max(height - z, 0.2))
        slack_x, slack_y = (width - w) / 2, (depth - d) / 2
        dx, dy = rng.uniform(-slack_x, slack_x), rng.uniform(-slack_y, slack_y)
        out.append(carton(rng, w, d, h).placed_at(x + dx, -(depth - d) / 2 + dy, z))
        z, w, d = z + h, w * rng.uniform(0.82, 1), d * rng.uniform(0.82, 1)
    return out


def shelf_load(rng: Rng, width: float, depth: float, height: float) -> list[Shape]:
    """Return the cartons on one shelf, of all sizes with gaps, at most `height` m high; may be empty."""
    out: list[Shape] = []
    x = -width / 2 + rng.uniform(0.0, 0.15)
    while True:
        w = rng.uniform(0.15, 0.6)
        if x + w > width / 2:
            return out
        d, h = depth * rng.uniform(0.6, 0.97), height * rng.uniform(0.35, 0.95)
        if rng.random() < 0.88:
            out += _one_or_two(rng, x + w / 2, w, d, h, -(depth - d) * rng.uniform(0.1, 0.6))
        x += w + float(rng.choice([0.01, 0.03, 0.12]))


def _one_or_two(rng: Rng, x: float, w: float, d: float, h: float, y: float) -> list[Shape]:
    """Return one carton, or two low ones on top of each other."""
    if h < 0.3 or rng.random() < 0.6:
        return [carton(rng, w, d, h).placed_at(x, y)]
    lower = h * rng.uniform(0.4, 0.6)
    return [
        carton(rng, w, d, lower).placed_at(x, y),
        carton(rng, 0.92 * w, 0.92 * d, h - lower).placed_at(x, y - 0.02, lower),
    ]
