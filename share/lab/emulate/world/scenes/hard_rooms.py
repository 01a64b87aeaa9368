"""Rooms that are hard for SLAM: two corridors that look alike, and white walls almost without features.

The corridors, around one core, provoke wrong merges. The whole is a ring: they run along x on both sides of
the core, short passages join them at both ends. The south corridor is the north one turned by half a turn
about the room's middle, so a walk around the ring passes the same views twice; only what `_add_differences`
adds distinguishes them. The passages differ.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from share.lab.emulate.world.furniture import building, equipment, storage
from share.lab.emulate.world.layout import Layout, Light, Piece
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Shape, concat_shapes, decal, quad
from share.lab.emulate.world.scenes import fill
from share.lab.emulate.world.scenes.fill import ShapeMaker
from share.lab.emulate.world.scenes.layout_builder import (
    LayoutBuilder,
    Size,
    Wall,
    Walls,
    add_skirting,
    build_enclosure,
    outer_walls,
    wall_surface,
)
from share.types import F64


def corridor_widths(size: Size) -> tuple[float, float]:
    """Return the widths of the corridors and of the passages at their ends, m."""
    return min(2.6, 0.37 * size[1]), min(2.8, 0.27 * size[0])


def twin_corridors(size: Size) -> tuple[F64, F64, F64]:
    """Return the two areas that look alike and their correspondence: lower and upper corner (2, 2) m of the
    north and of the south corridor, and T_south_north (4, 4), which takes the north one to the south one."""
    x, y, _ = size
    width, end = corridor_widths(size)
    north = np.array([(end, y - width), (x - end, y)])
    south = np.array([(end, 0), (x - end, width)])
    T = np.diag([-1.0, -1.0, 1.0, 1.0])
    T[:2, 3] = x, y
    return north, south, T


def corridor_twins(seed: int, size: Size) -> Layout:
    """One corridor is furnished, then copied; the passages have their own furniture."""
    rng = np.random.default_rng([seed, 14])
    plan = LayoutBuilder("corridor-twins", seed, size, rng)
    _, _, T = twin_corridors(size)
    walls, inner = outer_walls(size), _core(size)
    _build_shell(plan, walls, inner)
    _add_thresholds(plan)
    first_piece, first_light = len(plan.pieces), len(plan.lights)
    _furnish_corridor(plan, walls[0], inner[0])
    plan.pieces += [
        _turned_piece(p, T, len(plan.pieces) + k) for k, p in enumerate(plan.pieces[first_piece:])
    ]
    plan.occupied_boxes += [_turned_box(b, T) for b in plan.occupied_boxes]
    plan.lights += [_turned_light(light, T) for light in plan.lights[first_light:]]
    for outer, core in ((walls[1], inner[1]), (walls[3], inner[3])):
        _furnish_passage(plan, outer, core)
    _add_differences(plan, inner)
    return plan.to_layout(ambient=0.3)


def _core(size: Size) -> Walls:
    """Return the walls of the core, seen from outside it: north, east, south, west."""
    x, y, z = size
    wide, end = corridor_widths(size)
    (west, south), (east, north) = (end, wide), (x - end, y - wide)
    return (
        Wall(east, north, np.pi, east - west, z),
        Wall(east, south, np.pi / 2, north - south, z),
        Wall(west, south, 0, east - west, z),
        Wall(west, north, -np.pi / 2, north - south, z),
    )


def _build_shell(plan: LayoutBuilder, outer: Walls, inner: Walls) -> None:
    """One half of walls, floor and ceiling, and the same turned, so that the halves are identical."""
    rng, (x, y, z), T = plan.rng, plan.size, twin_corridors(plan.size)[2]
    paint = [(z, Material("plaster"))]
    floor = Material(str(rng.choice(["tiles", "planks", "carpet"])))
    half = [wall_surface(wall, paint, rng) for wall in outer[:2]]
    half.append(quad((0, y / 2, 0), (x, 0, 0), (0, y / 2, 0), floor, rng))
    half.append(quad((0, y, z), (x, 0, 0), (0, -y / 2, 0), Material("ceiling"), rng))
    for shape in half:
        plan.add_to_shell("shell", shape)
        plan.add_to_shell("shell", shape.transformed(T))
    sides = [wall_surface(wall, paint, rng) for wall in inner[:2]]
    plan.add_to_shell("core", concat_shapes(*sides, *(s.transformed(T) for s in sides), *_core_caps(plan)))
    add_skirting(plan, (*outer, *inner))


def _core_caps(plan: LayoutBuilder) -> list[Shape]:
    """Return bottom and top of the core, never visible, which make it closed and so solid."""
    (x, y, z), (wide, end) = plan.size, corridor_widths(plan.size)
    skin, long, short = Material("plaster"), (x - 2 * end, 0, 0), (0, y - 2 * wide, 0)
    return [quad((end, wide, z), long, short, skin), quad((end, wide, 0), short, long, skin)]


def _add_thresholds(plan: LayoutBuilder) -> None:
    """A metal strip in the floor of each passage where the halves meet."""
    (x, y, _), (_, end) = plan.size, corridor_widths(plan.size)
    for left in (0.0, x - end):
        strip = decal(
            (left, y / 2 - 0.02, 0), (end, 0, 0), (0, 0.04, 0), Material("galvanised"), offset=0.002
        )
        plan.add_unchecked("threshold", strip)


def _furnish_corridor(plan: LayoutBuilder, outer: Wall, inner: Wall) -> None:
    """Doors every 3 m on both sides, lamps, furniture along the outer wall."""
    rng, (wide, end) = plan.rng, corridor_widths(plan.size)
    length = inner.length
    count = max(2, int(length / 3.2))
    for k in range(count):
        at = length * (k + 0.5) / count
        if rng.random() < 0.8:
            fill.place_centred(plan, outer, "door", building.door(rng), end + at, 0.6)
        if rng.random() < 0.5:
            fill.place_centred(plan, inner, "door", building.door(rng), at, 0.6)
    strip = replace(outer, x=end, length=length)
    fill.furnish_wall(plan, strip, _FURNITURE, (0.3, 1.8))
    for wall in (strip, inner):
        fill.hang_on_wall(plan, wall, _HANGINGS, int(0.9 * length), 2.0)
    xs = [end + length * (k + 0.5) / count for k in range(count)]
    fill.light_tubes(plan, xs, [plan.size[1] - wide / 2], 1.2, 0.0)


_FURNITURE: dict[str, tuple[float, ShapeMaker]] = {
    "cupboard": (2, lambda r: storage.cupboard(r, r.uniform(0.7, 1.2), 0.34, r.uniform(1.1, 1.9))),
    "bench": (2, lambda r: equipment.bench(r, 1.3)),
    "chair": (2, equipment.chair),
    "lockers": (1, lambda r: storage.lockers(r, 3)),
    "radiator": (2, lambda r: building.radiator(r, 1.0)),
    "extinguisher": (1, equipment.extinguisher),
    "bin": (1, storage.waste_bin),
}

_HANGINGS: dict[str, tuple[float, ShapeMaker]] = {
    "poster": (3, building.poster),
    "notice": (3, building.notice),
    "sign": (2, building.sign),
    "pin board": (1, building.pin_board),
}


def _furnish_passage(plan: LayoutBuilder, outer: Wall, core: Wall) -> None:
    """An end of the ring: a window or a door, its own furniture, a lamp."""
    rng = plan.rng
    if rng.random() < 0.5:
        fill.add_window(
            plan, outer, outer.length / 2, 1.0, building.window(rng, 1.5, 1.1), rng.uniform(0.2, 0.4)
        )
    else:
        fill.place_centred(plan, outer, "door", building.door(rng), outer.length / 2, 0.8)
    fill.furnish_wall(plan, outer, _FURNITURE, (0.4, 1.6))
    for wall in (outer, core):
        fill.hang_on_wall(plan, wall, _HANGINGS, int(wall.length), 2.0)
    x, y = outer.point_before(outer.length / 2, corridor_widths(plan.size)[1] / 2)
    fill.light_tubes(plan, [x], [y], 1.2, 0.0)


def _add_differences(plan: LayoutBuilder, inner: Walls) -> None:
    """One more small object on each side, so that details distinguish the corridors."""
    for wall in (inner[0], inner[2]):
        fill.hang_on_wall(plan, wall, {"notice": (1, building.notice)}, 1, 1.7)


def _turned_piece(piece: Piece, T: F64, number: int) -> Piece:
    name = piece.name.rsplit(" ", 1)[0]
    return Piece(f"{name} {number}", piece.shape.transformed(T), piece.solid)


def _turned_box(box: F64, T: F64) -> F64:
    corners = box @ T[:3, :3].T + T[:3, 3]
    return np.stack([corners.min(0), corners.max(0)])


def _turned_light(light: Light, T: F64) -> Light:
    x, y, z = T[:3, :3] @ light.position + T[:3, 3]
    fx, fy, fz = T[:3, :3] @ light.facing
    return replace(light, position=(float(x), float(y), float(z)), facing=(float(fx), float(fy), float(fz)))


def whitewall(seed: int, size: Size) -> Layout:
    """A door, a radiator, a table with chairs, one or two small objects on the walls."""
    rng = np.random.default_rng([seed, 13])
    plan = LayoutBuilder("whitewall", seed, size, rng)
    walls = outer_walls(size)
    white, floor = Material("paint", 0, gray=180), Material("carpet", 0, contrast=0.25, gray=120)
    build_enclosure(plan, [(size[2], white)], floor, Material("paint", 1, gray=185))
    add_skirting(plan, walls)
    order = rng.permutation(4)
    door_at = rng.uniform(1, walls[order[0]].length - 1)
    fill.place_centred(plan, walls[order[0]], "door", building.door(rng), door_at, 1.2)
    fill.place_on_wall(plan, walls[order[1]], "radiator", building.radiator(rng, 1.2), rng.uniform(0.5, 3))
    fill.place_on_wall(plan, walls[order[2]], "bench", equipment.bench(rng, 1.4), rng.uniform(0.5, 3))
    fill.place_on_wall(plan, walls[order[3]], "bucket", equipment.bucket(rng), rng.uniform(0.5, 3))
    x, y = size[0] / 2 + rng.uniform(-0.5, 0.5), size[1] / 2 + rng.uniform(-0.2, 0.2)
    plan.add_if_free("table", equipment.table(rng, rng.uniform(1.2, 1.6)).placed_at(x, y + 0.4))
    plan.add_if_free("chair", equipment.chair(rng).placed_at(x + rng.uniform(-0.3, 0.3), y - 0.95, 0, np.pi))
    for wall in walls:
        fill.hang_on_wall(
            plan,
            wall,
            {"notice": (1, building.notice), "sign": (1, building.sign)},
            int(rng.integers(0, 2)),
            1.9,
        )
    xs, ys = [size[0] * f for f in (0.25, 0.75)], [size[1] * f for f in (0.3, 0.7)]
    fill.light_tubes(plan, xs, ys, 1.5, 0.0)
    return plan.to_layout(ambient=0.4)
