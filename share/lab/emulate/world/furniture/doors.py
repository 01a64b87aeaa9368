"""Doors, roller doors and windows, to be set on a wall."""

from __future__ import annotations

from share.lab.emulate.world.furniture.parts import box_on, pick_material, pick_print
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


def _door_leaf(rng: Rng, width: float, low: float, high: float, kind: str, y: float = -0.02) -> Shape:
    skin, cell = pick_print(rng, kind)
    return quad((-width / 2, y, low), (width, 0, 0), (0, 0, high - low), skin, rng, cell)


def door(rng: Rng) -> Shape:
    """A door of 0.9 x 2.05 m in its frame, with a handle and a lit sign above."""
    skin = pick_material(rng, "steel")
    sign, cell = pick_print(rng, "sign")
    return concat_shapes(
        [
            *_frame(rng, 0.9, 0, 2.05, skin),
            _door_leaf(rng, 0.9, 0, 2.05, "door"),
            box_on((0.37, -0.05, 1.0), (0.13, 0.03, 0.025), pick_material(rng, "galvanised"), rng),
            box((-0.2, -0.05, 2.2), (0.2, 0, 2.4), {"-y": sign, "all": skin}, rng, cell),
        ]
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
    return concat_shapes(out)


def window(rng: Rng, width: float, height: float) -> Shape:
    """A window with its frame and sill; its lower edge is at z = 0."""
    return concat_shapes(
        [
            *_frame(rng, width, 0.04, height, pick_material(rng, "steel"), 0.06),
            _door_leaf(rng, width, 0.04, height, "window"),
        ]
    )
