"""Signs, posters, boards and panels on walls."""

from __future__ import annotations

from share.lab.emulate.world.furniture.parts import pick_material, pick_print
from share.lab.emulate.world.mesh import Rng, Shape, box


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
