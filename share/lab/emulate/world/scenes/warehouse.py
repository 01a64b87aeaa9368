"""A warehouse: racks with cartons, pallets, pillars, signs, pipes, lamps and windows. Many features."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.world.furniture import building, equipment, storage, vehicles
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape
from share.lab.emulate.world.scenes import fill
from share.lab.emulate.world.scenes.fill import ShapeMaker
from share.lab.emulate.world.scenes.layout_builder import (
    BAY_M,
    LayoutBuilder,
    Size,
    Wall,
    add_columns,
    add_floor_joints,
    add_girders,
    bay_joints,
    build_enclosure,
    outer_walls,
)

_ROW_DEPTH_M = 0.85  # depth of a row of islands
_GIRDER_M = 0.3


def warehouse(seed: int, size: Size) -> Layout:
    """Furniture along the walls, rows of islands with aisles between them."""
    rng = np.random.default_rng([seed, 11])
    plan = LayoutBuilder("warehouse", seed, size, rng)
    walls = outer_walls(size)
    _build_shell(plan, walls)
    _add_openings(plan, walls)
    _add_islands(plan)
    _furnish_belt(plan, walls)
    _add_overhead(plan)
    for wall in walls:
        fill.hang_on_wall(plan, wall, _HANGINGS, int(1.1 * wall.length), min(size[2] - 0.5, 3.3))
    return plan.to_layout(ambient=0.12, brightness=0.9)


def _build_shell(plan: LayoutBuilder, walls: tuple[Wall, ...]) -> None:
    rng, z = plan.rng, plan.size[2]
    lower = Material(str(rng.choice(["block", "brick", "concrete"])), 0, contrast=0.8)
    upper = Material(str(rng.choice(["corrugated", "panel", "block", "plaster"])), 1, contrast=0.8)
    build_enclosure(
        plan,
        [(rng.uniform(1.8, 2.6), lower), (z, upper)],
        Material("screed", contrast=0.75),
        Material("corrugated", 0),
        BAY_M,
    )
    add_floor_joints(plan)
    add_columns(plan, walls[::2], z - _GIRDER_M)
    add_columns(plan, walls[1::2], z)
    add_girders(plan, _GIRDER_M)


def _add_openings(plan: LayoutBuilder, walls: tuple[Wall, ...]) -> None:
    """A roller door and a door on different walls, windows high up on the others."""
    rng, z = plan.rng, plan.size[2]
    order = rng.permutation(4)
    first, second = walls[order[0]], walls[order[1]]
    width = float(min(rng.uniform(2.2, 2.6), _bay_length(first) - 0.9))
    fill.place_centred(
        plan, first, "roller door", building.roller_door(rng, width, 2.6), _random_bay_middle(rng, first), 1.2
    )
    fill.place_centred(plan, second, "door", building.door(rng), _random_bay_middle(rng, second), 1.2)
    for k in order[1:]:
        for at in _bay_middles(walls[k]):
            if rng.random() < 0.45:
                tall = min(0.8, z - _GIRDER_M - 2.75)
                shape = building.window(rng, rng.uniform(1.0, 1.8), tall)
                fill.add_window(plan, walls[k], at, z - _GIRDER_M - tall - 0.15, shape, rng.uniform(0.5, 1.4))


def _bay_length(wall: Wall) -> float:
    return wall.length / (len(bay_joints(wall.length)) + 1)


def _bay_middles(wall: Wall) -> list[float]:
    return [_bay_length(wall) * (k + 0.5) for k in range(len(bay_joints(wall.length)) + 1)]


def _random_bay_middle(rng: Rng, wall: Wall) -> float:
    return float(rng.choice(_bay_middles(wall)))


def _belt_depth(size: Size) -> float:
    """Return the largest depth of furniture along walls: small in a small room, where people must pass."""
    return 0.62 if min(size[:2]) < 8 else 1.1


def _furnish_belt(plan: LayoutBuilder, walls: tuple[Wall, ...]) -> None:
    makers = _wall_furniture(plan.size) | (_DEEP_FURNITURE if _belt_depth(plan.size) > 1 else {})
    for wall in walls:
        fill.furnish_wall(plan, wall, makers, (0.03, 0.35))


def _rack_height(size: Size) -> float:
    return min(size[2] - 1.1, 5.0)


def _wall_furniture(size: Size) -> dict[str, tuple[float, ShapeMaker]]:
    """Return furniture along walls, at most 0.62 m deep: weight and function by name."""
    top = _rack_height(size)

    def rack(rng: Rng) -> Shape:
        height = rng.uniform(1.8, min(2.6, top)) if rng.random() < 0.6 else rng.uniform(0.75 * top, top)
        return storage.goods_rack(
            rng, rng.uniform(1.2, 2.4), rng.uniform(0.4, 0.55), height, rng.uniform(0.45, 0.8)
        )

    return {
        "rack": (5, rack),
        "cartons": (3, lambda r: storage.carton_stack(r, r.uniform(0.5, 1.4), 0.5, r.uniform(0.6, 1.7))),
        "cupboard": (1.5, lambda r: storage.cupboard(r, r.uniform(0.8, 1.6), 0.36, r.uniform(1.2, 2.1))),
        "drums": (1, lambda r: storage.drum_row(r, int(r.integers(1, 4)))),
        "workbench": (1.2, lambda r: equipment.workbench(r, r.uniform(1.3, 2.0))),
        "lockers": (0.6, lambda r: storage.lockers(r, int(r.integers(2, 5)))),
        "crate": (1, equipment.crate),
        "tool box": (0.6, equipment.tool_box),
        "bin": (0.5, storage.waste_bin),
        "hand truck": (0.6, equipment.hand_truck),
        "ladder": (0.5, lambda r: equipment.leaning_ladder(r, r.uniform(1.8, 2.1))),
        "extinguisher": (0.8, equipment.extinguisher),
        "conduit": (0.7, lambda r: building.wall_pipes(r, size[2])),
    }


_DEEP_FURNITURE: dict[str, tuple[float, ShapeMaker]] = {  # only where there is space for it
    "loaded pallet": (2, lambda r: storage.loaded_pallet(r, r.uniform(0.7, 1.8))),
    "pallets": (0.8, lambda r: storage.pallet_pile(r, int(r.integers(3, 9)))),
    "step ladder": (0.4, lambda r: equipment.step_ladder(r, r.uniform(0.9, 1.7))),
}


_HANGINGS: dict[str, tuple[float, ShapeMaker]] = {
    "sign": (4, building.sign),
    "poster": (3, building.poster),
    "notice": (3, building.notice),
    "pin board": (0.7, building.pin_board),
    "tool wall": (0.7, building.tool_wall),
    "fuse box": (1, building.fuse_box),
}


def _add_islands(plan: LayoutBuilder) -> None:
    """Rows of islands along x, with aisles between and around them and gaps in them."""
    x, y, _ = plan.size
    rng, margin = plan.rng, _belt_depth(plan.size) + (1.6 if y < 8 else 1.7)
    aisle = rng.uniform(1.8, 2.3)
    count = max(1, int((y - 2 * margin + aisle) / (_ROW_DEPTH_M + aisle)))
    spread = (y - 2 * margin - _ROW_DEPTH_M) / max(count - 1, 1) if count > 1 else 0.0
    for k in range(count):
        middle = margin + _ROW_DEPTH_M / 2 + k * spread if count > 1 else y / 2 + rng.uniform(-0.15, 0.15)
        _add_island_row(plan, middle, margin, x - margin, longest=1.9 if x < 12 else 6.0)


def _add_island_row(plan: LayoutBuilder, y: float, left: float, right: float, longest: float) -> None:
    """Islands from `left` to `right`, each in its frame of floor paint, some behind a pillar."""
    rng, x = plan.rng, left
    while right - x > 1.2:
        end = min(x + rng.uniform(1.25, longest), right)
        start = x
        if rng.random() < 0.5:
            plan.add_to_shell("pillar", _pillar(rng, plan.size[2]).placed_at(x + 0.25, y), is_reserved=True)
            x += 0.5
        x = _add_island(plan, x, end, y)
        fill.paint_rectangle(
            plan, (start - 0.12, y - _ROW_DEPTH_M / 2 - 0.1), (max(x, end) + 0.12, y + _ROW_DEPTH_M / 2 + 0.1)
        )
        x = max(x, end) + rng.uniform(1.5, 1.9)


def _pillar(rng: Rng, height: float) -> Shape:
    if rng.random() < 0.5:
        return building.concrete_pillar(rng, rng.uniform(0.28, 0.4), height)
    return building.steel_pillar(rng, 0.24, height)


def _add_island(plan: LayoutBuilder, left: float, right: float, y: float) -> float:
    """Racks end to end, or loads on pallets, from `left` as far as `right` allows; return where they end."""
    rng = plan.rng
    racks = rng.random() < (0.35 if right - left < 2 else 0.7)
    while right - left > 0.6:
        if racks and right - left >= 1.0:
            name, shape = "rack", _double_rack(plan, min(right - left, rng.uniform(1.6, 2.6)))
        else:
            name, shape = _floor_goods(rng, right - left)
        wide = float(np.ptp(shape.bounding_box[:, 0]))
        if wide > right - left + 1e-6:
            break
        facing = int(rng.choice([-1, 1]))
        x_own, y_own = (float(v) for v in facing * shape.bounding_box.mean(0)[:2])
        middle = left + wide / 2
        plan.add_if_free(name, shape.placed_at(middle - x_own, y - y_own, 0, 0.0 if facing > 0 else np.pi))
        left += wide + rng.uniform(0.02, 0.15)
    return left


def _double_rack(plan: LayoutBuilder, width: float) -> Shape:
    """A rack in the middle of the room, low under a low roof so that one can look over it."""
    rng, highest = plan.rng, _rack_height(plan.size)
    height = rng.uniform(1.5, min(2.4, highest)) if plan.size[2] < 5 else rng.uniform(0.6, 1) * highest
    return storage.goods_rack(rng, width, rng.uniform(0.6, _ROW_DEPTH_M), height, rng.uniform(0.5, 0.9))


def _floor_goods(rng: Rng, room: float) -> tuple[str, Shape]:
    """Return name and shape of something in the middle of a warehouse, narrower than `room` m."""
    if room > 4 and rng.random() < 0.3:
        return "forklift", vehicles.forklift(rng).placed_at(0, 0, 0, -np.pi / 2)
    kind = str(rng.choice(["loaded pallet", "pallets", "table", "crate", "drums", "cartons", "pallet truck"]))
    if room < 1.25 or kind == "crate":
        return "crate", equipment.crate(rng)
    if kind == "loaded pallet":
        return kind, storage.loaded_pallet(rng, rng.uniform(0.6, 1.6))
    if kind == "pallets":
        return kind, storage.pallet_pile(rng, int(rng.integers(2, 8)))
    if kind == "drums":
        return kind, storage.drum_row(rng, 2)
    if kind == "table":
        return kind, equipment.table(rng, min(room, rng.uniform(1.2, 1.8)))
    if kind == "pallet truck" and room > 1.7:
        return kind, vehicles.pallet_truck(rng).placed_at(0, 0, 0, -np.pi / 2)
    return "cartons", storage.carton_stack(rng, min(room, 1.4), 0.7, rng.uniform(0.8, 1.6))


def _add_overhead(plan: LayoutBuilder) -> None:
    x, y, z = plan.size
    middles = [x / (len(bay_joints(x)) + 1) * (k + 0.5) for k in range(len(bay_joints(x)) + 1)]
    shift = plan.rng.uniform(-0.4, 0.4)
    rows = max(2, round(y / 4))
    ys = [y * (k + 0.5) / rows for k in range(rows)]
    if z > 5.5:
        fill.light_bells(plan, [m + shift for m in middles[::2]], ys, plan.rng.uniform(0.4, 1.2))
    else:
        fill.light_tubes(
            plan, [m + shift for m in middles], ys, plan.rng.uniform(1.0, 1.5), plan.rng.uniform(0.1, 0.5)
        )
    fill.add_overhead_pipes(plan, len(middles) + 1)
