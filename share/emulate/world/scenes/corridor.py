"""Two long corridors that look alike, round one core: to provoke wrong merges.

The whole is a ring: the corridors run along x on both sides of the core, short passages join them at
both ends. The south corridor is the north one turned by half a turn about the room's middle, so whoever
walks round the ring sees the same twice; only what `_differences` adds tells them apart. The passages
differ.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from share.emulate.world.furniture import barrels, doors, hoses, lockers, pipes, shelving, signs, tables
from share.emulate.world.layout import Layout, Light, Piece
from share.emulate.world.materials import Material
from share.emulate.world.mesh import Rng, concat, quad
from share.emulate.world.scenes import fill
from share.emulate.world.scenes.fill import Maker
from share.emulate.world.scenes.plan import Plan, Size, Wall, outer_walls
from share.emulate.world.scenes.shell import enclose, skirting
from share.types import F64


def widths(size: Size) -> tuple[float, float]:
    """Of the corridors and of the passages at their ends, m."""
    return min(2.6, 0.37 * size[1]), min(2.8, 0.27 * size[0])


def twins(size: Size) -> tuple[F64, F64, F64]:
    """The two areas that look alike, and how they correspond: lower and upper corner (2, 2) m of the
    north and of the south corridor, and T_south_north (4, 4), which takes the one to the other."""
    x, y, _ = size
    wide, end = widths(size)
    north = np.array([(end, y - wide), (x - end, y)])
    south = np.array([(end, 0), (x - end, wide)])
    T = np.diag([-1.0, -1.0, 1.0, 1.0])
    T[:2, 3] = x, y
    return north, south, T


def corridor_twins(seed: int, size: Size) -> Layout:
    """One corridor is furnished, then copied; the passages get furniture of their own."""
    rng = np.random.default_rng([seed, 14])
    plan = Plan("corridor-twins", seed, size, rng)
    _, _, T = twins(size)
    walls, inner = outer_walls(size), _core(size)
    _shell(plan, (*walls, *inner))
    made, lit = len(plan.pieces), len(plan.lights)
    _corridor(plan, walls[0], inner[0])
    plan.pieces += [_turned(p, T, len(plan.pieces) + k) for k, p in enumerate(plan.pieces[made:])]
    plan.taken += [_turned_box(b, T) for b in plan.taken]
    plan.lights += [_turned_light(light, T) for light in plan.lights[lit:]]
    for outer, core in ((walls[1], inner[1]), (walls[3], inner[3])):
        _passage(plan, outer, core)
    _differences(plan, walls, inner)
    return plan.done(ambient=0.3)


def _core(size: Size) -> tuple[Wall, Wall, Wall, Wall]:
    """The walls of the core, seen from outside it: north, east, south, west."""
    x, y, z = size
    wide, end = widths(size)
    (l, b), (r, t) = (end, wide), (x - end, y - wide)
    return (
        Wall(r, t, np.pi, r - l, z),
        Wall(r, b, np.pi / 2, t - b, z),
        Wall(l, b, 0, r - l, z),
        Wall(l, t, -np.pi / 2, t - b, z),
    )


def _shell(plan: Plan, walls: tuple[Wall, ...]) -> None:
    """The same paint on all walls, no seams that could tell one place from another."""
    rng, z = plan.rng, plan.size[2]
    low, high = Material("plaster", 0, gray=150), Material("plaster", 1)
    edge = rng.uniform(0.9, 1.2)
    floor = Material(str(rng.choice(["tiles", "planks", "carpet"])))
    enclose(plan, [(z, high)], floor, Material("ceiling"))
    del low, edge
    for wall in walls[4:]:
        plan.build("core", wall.put(quad((0, 0, 0), (wall.length, 0, 0), (0, 0, z), high, rng), 0))
    skirting(plan, walls)


def _corridor(plan: Plan, outer: Wall, inner: Wall) -> None:
    """Doors every 3 m on both sides, lamps, furniture along the outer wall."""
    rng, (wide, end) = plan.rng, widths(plan.size)
    z, length = plan.size[2], inner.length
    count = max(2, int(length / 3.2))
    for k in range(count):
        at = length * (k + 0.5) / count
        if rng.random() < 0.8:
            fill.centred(plan, outer, "door", doors.door(rng), end + at, 0.6)
        if rng.random() < 0.5:
            fill.centred(plan, inner, "door", doors.door(rng), at, 0.6)
    strip = replace(outer, x=end, length=length)
    fill.along(plan, strip, _FURNITURE, (0.3, 1.8))
    for wall in (strip, inner):
        fill.hang(plan, wall, _HANGINGS, int(0.9 * length), 2.0)
    xs = [end + length * (k + 0.5) / count for k in range(count)]
    fill.light_tubes(plan, xs, [plan.size[1] - wide / 2], 1.2, 0.0)
    del z


_FURNITURE: dict[str, tuple[float, Maker]] = {
    "cupboard": (2, lambda r: shelving.cupboard(r, r.uniform(0.7, 1.2), 0.34, r.uniform(1.1, 1.9))),
    "bench": (2, lambda r: tables.bench(r, 1.3)),
    "chair": (2, tables.chair),
    "lockers": (1, lambda r: lockers.lockers(r, 3)),
    "radiator": (2, lambda r: pipes.radiator(r, 1.0)),
    "extinguisher": (1, hoses.extinguisher),
    "bin": (1, barrels.bin_),
}

_HANGINGS: dict[str, tuple[float, Maker]] = {
    "poster": (3, signs.poster),
    "notice": (3, signs.notice),
    "sign": (2, signs.sign),
    "pin board": (1, signs.pin_board),
}


def _passage(plan: Plan, outer: Wall, core: Wall) -> None:
    """An end of the ring: a window or a door, furniture of its own, a lamp."""
    rng = plan.rng
    if rng.random() < 0.5:
        fill.daylight(plan, outer, outer.length / 2, 1.0, doors.window(rng, 1.5, 1.1), rng.uniform(1, 2))
    else:
        fill.centred(plan, outer, "door", doors.door(rng), outer.length / 2, 0.8)
    fill.along(plan, outer, _FURNITURE, (0.4, 1.6))
    for wall in (outer, core):
        fill.hang(plan, wall, _HANGINGS, int(wall.length), 2.0)
    at = core.put(
        concat([quad((-0.01, -1.3, 0), (0.02, 0, 0), (0, 0, 1), Material("paint"))]), core.length / 2
    )
    x, y = at.bounds[:, :2].mean(0)
    fill.light_tubes(plan, [float(x)], [float(y)], 1.2, 0.0)


def _differences(plan: Plan, walls: tuple[Wall, ...], inner: tuple[Wall, ...]) -> None:
    """One small thing more on each side, so that the truth can be told by looking closely."""
    for wall in (inner[0], inner[2]):
        fill.hang(plan, wall, {"notice": (1, signs.notice)}, 1, 1.7)
    del walls


def _turned(piece: Piece, T: F64, number: int) -> Piece:
    name = piece.name.rsplit(" ", 1)[0]
    return Piece(f"{name} {number}", piece.shape.moved(T), piece.solid)


def _turned_box(box: F64, T: F64) -> F64:
    corners = box @ T[:3, :3].T + T[:3, 3]
    return np.stack([corners.min(0), corners.max(0)])


def _turned_light(light: Light, T: F64) -> Light:
    x, y, z = T[:3, :3] @ light.position + T[:3, 3]
    fx, fy, fz = T[:3, :3] @ light.facing
    return replace(light, position=(float(x), float(y), float(z)), facing=(float(fx), float(fy), float(fz)))


_ = Rng
