"""Pillars that carry the roof: concrete and steel."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.world.furniture.parts import box_on, front_print, pick_material
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, box, concat_shapes


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
    return concat_shapes(out)


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
    return concat_shapes(out)


def girder(rng: Rng, length: float, height: float) -> Shape:
    """An I-beam along x; its top flange, z = `height`, touches the ceiling."""
    skin, t, w = pick_material(rng, "steel"), 0.018, 0.6 * height
    out = [box_on((0, 0, z), (length, w, t), skin, rng) for z in (0.0, height - t)]
    out.append(box_on((0, 0, t), (length, 0.014, height - 2 * t), skin, rng))
    for k in range(1, int(length / 1.5) + 1):
        x = min(k * 1.5, length - 0.1) - length / 2
        out.append(box_on((x, 0, t), (0.012, w * 0.9, height - 2 * t), skin, rng))
    return concat_shapes(out)
