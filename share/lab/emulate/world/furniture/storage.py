"""Where goods are kept: drums, bins, cartons, pallets (EN 13698), racks, cupboards and lockers."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.world.furniture.parts import (
    box_on,
    corner_posts,
    front_print,
    pick_material,
    pick_print,
    strut,
)
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, box, concat_shapes, cylinder, decal, quad

_DRUM_RADIUS, _DRUM_HEIGHT = 0.29, 0.88  # m; a drum of 200 l


def drum(rng: Rng) -> Shape:
    """A steel drum with two swages and a rim; some carry a label."""
    skin, lid = pick_material(rng, "steel"), pick_material(rng, "steel")
    y = -_DRUM_RADIUS
    out = [cylinder((0, y, 0), _DRUM_RADIUS - 0.01, _DRUM_HEIGHT - 0.02, skin, lid, sides=18, rng=rng)]
    for z in (0.0, 0.29, 0.57, _DRUM_HEIGHT - 0.03):
        out.append(cylinder((0, y, z), _DRUM_RADIUS, 0.03, skin, None, sides=18, rng=rng))
    if rng.random() < 0.7:
        out.append(front_print(rng, -0.09, 0.36, 0.18, 0.16, "label", -2 * _DRUM_RADIUS))
    return concat_shapes(*out)


def drum_row(rng: Rng, count: int) -> Shape:
    """Drums in a row."""
    pitch = 2 * _DRUM_RADIUS + 0.03
    return concat_shapes(*[drum(rng).placed_at((k - (count - 1) / 2) * pitch, 0) for k in range(count)])


def waste_bin(rng: Rng) -> Shape:
    """A waste bin, wider at the top, open."""
    skin = pick_material(rng, "plastic")
    hull = cylinder((0, -0.22, 0), 0.17, 0.6, skin, None, rng=rng, top=0.21)
    rim = cylinder((0, -0.22, 0.57), 0.22, 0.03, skin, None, rng=rng)
    floor = cylinder((0, -0.22, 0.02), 0.155, 0.3, skin, pick_material(rng, "fabric"), rng=rng, top=0.175)
    return concat_shapes(hull, rim, floor)


# Cartons.

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
    return concat_shapes(*out)


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
    return concat_shapes(*out)


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


# Pallets.

_PALLET_W, _PALLET_D, _PALLET_H = 1.2, 0.8, 0.144


def pallet(rng: Rng) -> Shape:
    """Top boards over stringers over nine blocks over skids."""
    skin, out = pick_material(rng, "wood"), []
    for y in (-0.05, -_PALLET_D / 2, 0.05 - _PALLET_D):
        out.append(box_on((0, y, 0), (_PALLET_W, 0.1, 0.022), skin, rng))
        out += [box_on((x, y, 0.022), (0.145, 0.1, 0.078), skin, rng) for x in (-0.5275, 0, 0.5275)]
    stringers = (-0.5275, 0, 0.5275)
    out += [box_on((x, -_PALLET_D / 2, 0.1), (0.145, _PALLET_D, 0.022), skin, rng) for x in stringers]
    tops = -np.linspace(0.06, _PALLET_D - 0.06, 6)
    out += [box_on((0, y, 0.122), (_PALLET_W, 0.11, 0.022), skin, rng) for y in tops]
    return concat_shapes(*out)


def pallet_pile(rng: Rng, count: int) -> Shape:
    """A stack of bare pallets, slightly out of line."""
    shift = rng.uniform(-0.03, 0.03, count)
    return concat_shapes(*[pallet(rng).placed_at(float(s), 0, k * _PALLET_H) for k, s in enumerate(shift)])


def loaded_pallet(rng: Rng, height: float) -> Shape:
    """A pallet with goods up to `height` m: cartons in layers, sacks, or a block under foil."""
    goods = (_carton_layers, _sacks, _wrapped_block)[int(rng.integers(3))]
    base = pallet(rng)
    load = goods(rng, max(height - _PALLET_H, 0.3))
    return concat_shapes(base, *(s.placed_at(0, 0, _PALLET_H) for s in load))


def _carton_layers(rng: Rng, height: float) -> list[Shape]:
    nx, ny = int(rng.integers(2, 5)), int(rng.integers(1, 4))
    h = float(rng.uniform(0.2, 0.4))
    w, d, out = _PALLET_W / nx, _PALLET_D / ny, []
    for k in range(max(1, int(height / h))):
        for i in range(nx):
            for j in range(ny):
                if k and k >= int(height / h) - 1 and rng.random() < 0.3:
                    continue  # the top layer is incomplete
                x = (i + 0.5) * w - _PALLET_W / 2
                out.append(carton(rng, w - 0.012, d - 0.012, h - 0.002).placed_at(x, -j * d - 0.006, k * h))
    return out


def _sacks(rng: Rng, height: float) -> list[Shape]:
    skin, h = Material("fabric", 1, gray=float(rng.choice([120, 165]))), 0.13
    out = []
    for k in range(max(1, int(height / h))):
        for x in (-0.3, 0.3):
            for y in (-0.2, -0.6):
                size = (0.56 + rng.uniform(-0.02, 0.02), 0.37, h - 0.004)
                out.append(box_on((x, y, k * h), size, skin, rng))
        out.append(front_print(rng, -0.5, k * h + 0.02, 0.4, 0.09, "label", -0.785))
    return out


def _wrapped_block(rng: Rng, height: float) -> list[Shape]:
    x = _PALLET_W / 2 - 0.02
    low, high = (-x, -_PALLET_D + 0.02, 0), (x, -0.02, height)
    body = box(low, high, {"all": pick_material(rng, "foil"), "bottom": None}, rng)
    return [body, front_print(rng, 0.05, height * 0.6, 0.21, 0.15, "label", -_PALLET_D + 0.02)]


# Racks and cupboards.

_POST_M = 0.05
_BOARD_M = 0.025
_BEAM_M = 0.07


def goods_rack(rng: Rng, width: float, depth: float, height: float, pitch: float) -> Shape:
    """Posts, beams, boards about every `pitch` m, braced ends, cartons and bins on every level. The goods on
    top stay below `height` + 0.35 m."""
    paint, beam, board = (pick_material(rng, kind) for kind in ("steel", "steel", "plywood"))
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
    return concat_shapes(*out)


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
        hull, fill, front_print(rng, -0.05, 0.3 * height, 0.1, 0.3 * height, "label", -depth)
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
    return concat_shapes(*out)


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


# Lockers and cloakrooms.


def lockers(rng: Rng, count: int) -> Shape:
    """A row of steel lockers on a plinth, each door with its vents, lock and number."""
    w, d, h = 0.4, 0.48, 1.85
    skin, width = pick_material(rng, "steel"), count * w
    out = [
        box_on((0, -d / 2 - 0.01, 0), (width - 0.04, d - 0.06, 0.08), Material("rubber"), rng),
        box((-width / 2, -d, 0.08), (width / 2, 0, h), {"all": skin, "+y": None}, rng),
    ]
    print_, cell = pick_print(rng, "locker")
    for k in range(count):
        x = -width / 2 + k * w + 0.008
        out.append(quad((x, -d - 0.012, 0.1), (w - 0.016, 0, 0), (0, 0, h - 0.12), print_, rng, cell))
        lock = pick_material(rng, "galvanised")
        out.append(box_on((x + 0.33, -d - 0.02, 1.0), (0.02, 0.02, 0.09), lock, rng))
    return concat_shapes(*out)


def cloakroom(rng: Rng, count: int) -> Shape:
    """Places for turnout gear: dividers, a shelf with helmets, jackets on hooks, boots below."""
    skin, pitch, d = pick_material(rng, "steel"), 0.5, 0.42
    width = count * pitch
    out = [box_on(((k - count / 2) * pitch, -d / 2, 0), (0.02, d, 1.9), skin, rng) for k in range(count + 1)]
    out += [box((-width / 2 + 0.01, -d, z), (width / 2 - 0.01, 0, z + 0.02), skin, rng) for z in (0.3, 1.6)]
    for k in range(count):
        out += _turnout_gear(rng, (k + 0.5 - count / 2) * pitch)
    return concat_shapes(*out)


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
