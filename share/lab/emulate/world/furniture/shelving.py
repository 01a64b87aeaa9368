"""Shelving: industrial racks with goods, and cupboards with files."""

from __future__ import annotations

from share.lab.emulate.world.furniture.cartons import shelf_load
from share.lab.emulate.world.furniture.parts import (
    box_on,
    corner_posts,
    front_print,
    pick_material,
    pick_print,
    strut,
)
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, box, concat_shapes, quad

_POST_M = 0.05
_BOARD_M = 0.025
_BEAM_M = 0.07


def goods_rack(rng: Rng, width: float, depth: float, height: float, pitch: float) -> Shape:
    """Posts, beams, boards about every `pitch` m, braced ends, cartons and bins on every level. The goods on
    top stay below `height` + 0.35 m."""
    paint, beam, board = (
        pick_material(rng, "steel"),
        pick_material(rng, "steel"),
        pick_material(rng, "plywood"),
    )
    levels = max(2, round(height / pitch))
    out = [corner_posts(width, depth, height, _POST_M, paint, rng), *_braces(rng, width, depth, height)]
    for k in range(levels):
        z = 0.12 + k * (height - 0.2) / (levels - 1)
        out += _rack_level(rng, width, depth, z, beam, board)
        room = (height - 0.2) / (levels - 1) - _BEAM_M - 0.06 if k < levels - 1 else 0.35
        out += [
            s.placed_at(0, -0.02, z + _BOARD_M)
            for s in _goods(rng, width - 2 * _POST_M - 0.04, depth - 0.06, room)
        ]
    return concat_shapes(out)


def _rack_level(
    rng: Rng, width: float, depth: float, z: float, beam: Material, board: Material
) -> list[Shape]:
    inner = width - 2 * _POST_M
    out = [box_on((0, y, z - _BEAM_M), (inner, 0.03, _BEAM_M), beam, rng) for y in (-depth + 0.02, -0.02)]
    return [*out, box_on((0, -depth / 2, z), (inner, depth - 0.012, _BOARD_M), board, rng)]


def _braces(rng: Rng, width: float, depth: float, height: float) -> list[Shape]:
    """Diagonals between the posts of both ends."""
    skin, out = pick_material(rng, "galvanised"), []
    steps = max(1, round(height / 0.9))
    for x in (-(width - _POST_M) / 2, (width - _POST_M) / 2):
        for k in range(steps):
            ends = [(x, y, 0.15 + (height - 0.3) * n / steps) for y, n in ((-0.05, k), (0.05 - depth, k + 1))]
            if k % 2:
                ends = [(x, -depth - y, z) for _, y, z in ends]
            out.append(strut(ends[0], ends[1], 0.02, skin, rng))
    return out


def _goods(rng: Rng, width: float, depth: float, room: float) -> list[Shape]:
    if rng.random() < 0.2:
        return _bins(rng, width, depth, min(room, 0.3))
    return shelf_load(rng, width, depth, room)


def _bins(rng: Rng, width: float, depth: float, height: float) -> list[Shape]:
    """A row of open plastic bins with small objects in them."""
    count = max(1, int(width / 0.28))
    skin, pitch = pick_material(rng, "plastic"), width / count
    return [
        _bin(rng, pitch - 0.02, depth * 0.9, 0.7 * height, skin).placed_at((k + 0.5) * pitch - width / 2, 0)
        for k in range(count)
    ]


def _bin(rng: Rng, width: float, depth: float, height: float, skin: Material) -> Shape:
    goods, cell = pick_print(rng, "goods")
    hull = box((-width / 2, -depth, 0), (width / 2, 0, height), {"side": skin}, rng)
    fill = quad((-width / 2, -depth, 0.85 * height), (width, 0, 0), (0, depth, 0), goods, rng, cell)
    return concat_shapes(
        [hull, fill, front_print(rng, -0.05, 0.3 * height, 0.1, 0.3 * height, "label", -depth)]
    )


def cupboard(rng: Rng, width: float, depth: float, height: float) -> Shape:
    """An open cupboard: sides, back, boards, and files or small goods on them."""
    skin, t = pick_material(rng, "wood"), 0.02
    half, rows = width / 2, max(2, round(height / 0.38))
    out = [
        box((-half, -depth, 0), (-half + t, 0, height), skin, rng),
        box((half - t, -depth, 0), (half, 0, height), skin, rng),
        box((-half + t, -t, 0), (half - t, 0, height), skin, rng),
    ]
    step = (height - t - 0.06) / rows
    for k in range(rows + 1):
        z = 0.06 + k * step
        out.append(box((-half + t, -depth, z), (half - t, -t, z + t), skin, rng))
        if k < rows:
            out += _cupboard_row(rng, width - 2 * t, depth - t, z + t, step - t)
    return concat_shapes(out)


def _cupboard_row(rng: Rng, width: float, depth: float, z: float, height: float) -> list[Shape]:
    """Runs of files or goods of several heights and depths, with gaps."""
    out, x = [], -width / 2 + 0.005
    while x < width / 2 - 0.15:
        w = min(rng.uniform(0.2, 0.6), width / 2 - 0.005 - x)
        if rng.random() < 0.85:
            d, h = depth * rng.uniform(0.6, 0.9), height * rng.uniform(0.6, 0.92)
            skins, cell = pick_print(rng, str(rng.choice(["books", "goods"])))
            rest = pick_material(rng, "cardboard")
            low, high = (x, -0.02 - d, z), (x + w, -0.02, z + h)
            out.append(box(low, high, {"-y": skins, "all": rest, "bottom": None, "+y": None}, rng, cell))
        x += w + rng.uniform(0.01, 0.1)
    return out
