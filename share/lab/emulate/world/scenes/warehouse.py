"""A warehouse: racks with cartons, pallets, pillars, signs, pipes, lamps and windows. Much to see."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.world.furniture import (
    barrels,
    cartons,
    doors,
    forklift,
    hoses,
    ladders,
    lockers,
    pallets,
    pillars,
    pipes,
    shelving,
    signs,
    small,
    tables,
)
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape
from share.lab.emulate.world.scenes import fill
from share.lab.emulate.world.scenes.fill import Maker
from share.lab.emulate.world.scenes.plan import Plan, Size, Wall, outer_walls
from share.lab.emulate.world.scenes.shell import BAY, bays, columns, enclose, girders, joints

_ROW = 0.85  # m; depth of a row of islands
_GIRDER = 0.3


def warehouse(seed: int, size: Size) -> Layout:
    """Furniture along the walls, rows of islands with aisles between them."""
    rng = np.random.default_rng([seed, 11])
    plan = Plan("warehouse", seed, size, rng)
    walls = outer_walls(size)
    _shell(plan, walls)
    _openings(plan, walls)
    _rows(plan)
    _belt(plan, walls)
    _overhead(plan)
    for wall in walls:
        fill.hang(plan, wall, _HANGINGS, int(1.1 * wall.length), min(size[2] - 0.5, 3.3))
    return plan.done(ambient=0.12, brightness=0.9)


def _shell(plan: Plan, walls: tuple[Wall, ...]) -> None:
    rng, z = plan.rng, plan.size[2]
    lower = Material(str(rng.choice(["block", "brick", "concrete"])), 0, contrast=0.8)
    upper = Material(str(rng.choice(["corrugated", "panel", "block", "plaster"])), 1, contrast=0.8)
    enclose(
        plan,
        [(rng.uniform(1.8, 2.6), lower), (z, upper)],
        Material("screed", contrast=0.75),
        Material("corrugated", 0),
        BAY,
    )
    joints(plan)
    columns(plan, walls[::2], z - _GIRDER)
    columns(plan, walls[1::2], z)
    girders(plan, _GIRDER)


def _openings(plan: Plan, walls: tuple[Wall, ...]) -> None:
    """A roller door and a door on different walls, windows high up on the others."""
    rng, z = plan.rng, plan.size[2]
    order = rng.permutation(4)
    first, second = walls[order[0]], walls[order[1]]
    width = float(min(rng.uniform(2.2, 2.6), _bay(first) - 0.9))
    fill.centred(plan, first, "roller door", doors.roller(rng, width, 2.6), _middle(rng, first), 1.2)
    fill.centred(plan, second, "door", doors.door(rng), _middle(rng, second), 1.2)
    for k in order[1:]:
        for at in _middles(walls[k]):
            if rng.random() < 0.45:
                tall = min(0.8, z - _GIRDER - 2.75)
                shape = doors.window(rng, rng.uniform(1.0, 1.8), tall)
                fill.daylight(plan, walls[k], at, z - _GIRDER - tall - 0.15, shape, rng.uniform(0.5, 1.4))


def _bay(wall: Wall) -> float:
    return wall.length / (len(bays(wall.length)) + 1)


def _middles(wall: Wall) -> list[float]:
    return [_bay(wall) * (k + 0.5) for k in range(len(bays(wall.length)) + 1)]


def _middle(rng: Rng, wall: Wall) -> float:
    return float(rng.choice(_middles(wall)))


def _belt_depth(size: Size) -> float:
    """How deep furniture along walls may be: little in a small room, where people must pass."""
    return 0.62 if min(size[:2]) < 8 else 1.1


def _belt(plan: Plan, walls: tuple[Wall, ...]) -> None:
    makers = _standing(plan.size) | (_DEEP if _belt_depth(plan.size) > 1 else {})
    for wall in walls:
        fill.along(plan, wall, makers, (0.03, 0.35))


def _rack_height(size: Size) -> float:
    return min(size[2] - 1.1, 5.0)


def _standing(size: Size) -> dict[str, tuple[float, Maker]]:
    """What stands along walls, not deeper than 0.62 m: how often, and how it is made."""
    top = _rack_height(size)

    def rack(rng: Rng) -> Shape:
        height = rng.uniform(1.8, min(2.6, top)) if rng.random() < 0.6 else rng.uniform(0.75 * top, top)
        return shelving.rack(
            rng, rng.uniform(1.2, 2.4), rng.uniform(0.4, 0.55), height, rng.uniform(0.45, 0.8)
        )

    return {
        "rack": (5, rack),
        "cartons": (3, lambda r: cartons.stack(r, r.uniform(0.5, 1.4), 0.5, r.uniform(0.6, 1.7))),
        "cupboard": (1.5, lambda r: shelving.cupboard(r, r.uniform(0.8, 1.6), 0.36, r.uniform(1.2, 2.1))),
        "drums": (1, lambda r: barrels.drums(r, int(r.integers(1, 4)))),
        "workbench": (1.2, lambda r: tables.workbench(r, r.uniform(1.3, 2.0))),
        "lockers": (0.6, lambda r: lockers.lockers(r, int(r.integers(2, 5)))),
        "crate": (1, small.crate),
        "tool box": (0.6, small.tool_box),
        "bin": (0.5, barrels.bin_),
        "hand truck": (0.6, small.hand_truck),
        "ladder": (0.5, lambda r: ladders.leaning(r, r.uniform(1.8, 2.1))),
        "extinguisher": (0.8, hoses.extinguisher),
        "conduit": (0.7, lambda r: pipes.conduit(r, size[2])),
    }


_DEEP: dict[str, tuple[float, Maker]] = {  # only where there is room for it
    "loaded pallet": (2, lambda r: pallets.loaded(r, r.uniform(0.7, 1.8))),
    "pallets": (0.8, lambda r: pallets.pile(r, int(r.integers(3, 9)))),
    "step ladder": (0.4, lambda r: ladders.step(r, r.uniform(0.9, 1.7))),
}


_HANGINGS: dict[str, tuple[float, Maker]] = {
    "sign": (4, signs.sign),
    "poster": (3, signs.poster),
    "notice": (3, signs.notice),
    "pin board": (0.7, signs.pin_board),
    "tool wall": (0.7, signs.tool_wall),
    "fuse box": (1, signs.fuse_box),
}


def _rows(plan: Plan) -> None:
    """Rows of islands along x; between them, round them and at gaps in them one can pass."""
    x, y, _ = plan.size
    rng, margin = plan.rng, _belt_depth(plan.size) + (1.6 if y < 8 else 1.7)
    aisle = rng.uniform(1.8, 2.3)
    count = max(1, int((y - 2 * margin + aisle) / (_ROW + aisle)))
    spread = (y - 2 * margin - _ROW) / max(count - 1, 1) if count > 1 else 0.0
    for k in range(count):
        middle = margin + _ROW / 2 + k * spread if count > 1 else y / 2 + rng.uniform(-0.15, 0.15)
        _row(plan, middle, margin, x - margin, longest=1.9 if x < 12 else 6.0)


def _row(plan: Plan, y: float, left: float, right: float, longest: float) -> None:
    """Islands from `left` to `right`, each in its frame of floor paint, some behind a pillar."""
    rng, x = plan.rng, left
    while right - x > 1.2:
        end = min(x + rng.uniform(1.25, longest), right)
        start = x
        if rng.random() < 0.5:
            plan.build("pillar", _pillar(rng, plan.size[2]).at(x + 0.25, y), keeps_off=True)
            x += 0.5
        x = _island(plan, x, end, y)
        fill.frame(plan, (start - 0.12, y - _ROW / 2 - 0.1), (max(x, end) + 0.12, y + _ROW / 2 + 0.1))
        x = max(x, end) + rng.uniform(1.5, 1.9)


def _pillar(rng: Rng, height: float) -> Shape:
    if rng.random() < 0.5:
        return pillars.concrete(rng, rng.uniform(0.28, 0.4), height)
    return pillars.steel(rng, 0.24, height)


def _island(plan: Plan, left: float, right: float, y: float) -> float:
    """Racks end to end, or things on pallets, from `left` as far as `right` allows; where it ended."""
    rng = plan.rng
    racks = rng.random() < (0.35 if right - left < 2 else 0.7)
    while right - left > 0.6:
        if racks and right - left >= 1.0:
            name, shape = "rack", _double_rack(plan, min(right - left, rng.uniform(1.6, 2.6)))
        else:
            name, shape = _goods(rng, right - left)
        wide = float(np.ptp(shape.bounds[:, 0]))
        if wide > right - left + 1e-6:
            break
        facing = int(rng.choice([-1, 1]))
        x_own, y_own = (float(v) for v in facing * shape.bounds.mean(0)[:2])
        middle = left + wide / 2
        plan.add(name, shape.at(middle - x_own, y - y_own, 0, 0.0 if facing > 0 else np.pi))
        left += wide + rng.uniform(0.02, 0.15)
    return left


def _double_rack(plan: Plan, width: float) -> Shape:
    """A rack in the middle: low under a low roof, that one sees over it."""
    rng, highest = plan.rng, _rack_height(plan.size)
    height = rng.uniform(1.5, min(2.4, highest)) if plan.size[2] < 5 else rng.uniform(0.6, 1) * highest
    return shelving.rack(rng, width, rng.uniform(0.6, _ROW), height, rng.uniform(0.5, 0.9))


def _goods(rng: Rng, room: float) -> tuple[str, Shape]:
    """Something that stands in the middle of a warehouse and is narrower than `room` m."""
    if room > 4 and rng.random() < 0.3:
        return "forklift", forklift.forklift(rng).at(0, 0, 0, -np.pi / 2)
    kind = str(rng.choice(["loaded pallet", "pallets", "table", "crate", "drums", "cartons", "pallet truck"]))
    if room < 1.25 or kind == "crate":
        return "crate", small.crate(rng)
    if kind == "loaded pallet":
        return kind, pallets.loaded(rng, rng.uniform(0.6, 1.6))
    if kind == "pallets":
        return kind, pallets.pile(rng, int(rng.integers(2, 8)))
    if kind == "drums":
        return kind, barrels.drums(rng, 2)
    if kind == "table":
        return kind, tables.table(rng, min(room, rng.uniform(1.2, 1.8)))
    if kind == "pallet truck" and room > 1.7:
        return kind, forklift.pallet_truck(rng).at(0, 0, 0, -np.pi / 2)
    return "cartons", cartons.stack(rng, min(room, 1.4), 0.7, rng.uniform(0.8, 1.6))


def _overhead(plan: Plan) -> None:
    x, y, z = plan.size
    middles = [x / (len(bays(x)) + 1) * (k + 0.5) for k in range(len(bays(x)) + 1)]
    shift = plan.rng.uniform(-0.4, 0.4)
    rows = max(2, round(y / 4))
    ys = [y * (k + 0.5) / rows for k in range(rows)]
    if z > 5.5:
        fill.light_bells(plan, [m + shift for m in middles[::2]], ys, plan.rng.uniform(0.4, 1.2))
    else:
        fill.light_tubes(
            plan, [m + shift for m in middles], ys, plan.rng.uniform(1.0, 1.5), plan.rng.uniform(0.1, 0.5)
        )
    fill.overhead(plan, len(middles) + 1)
