"""A fire station's hall: large, plain walls and floor, a vehicle or two, little else. Few features."""

from __future__ import annotations

import numpy as np

from share.lab.emulate.world.furniture import building, equipment, storage, vehicles
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.scenes import fill
from share.lab.emulate.world.scenes.fill import ShapeMaker
from share.lab.emulate.world.scenes.layout_builder import (
    LayoutBuilder,
    Size,
    Wall,
    add_floor_joints,
    add_skirting,
    build_enclosure,
    clear_floor,
    outer_walls,
)

_AISLE_M = 1.75  # around the vehicles
_MIN_WALKABLE = 0.3  # least share of the floor that is left to walk on


def firestation(seed: int, size: Size) -> Layout:
    """Vehicles that face the roller doors of the east wall; gear along the other walls."""
    rng = np.random.default_rng([seed, 12])
    plan = LayoutBuilder("firestation", seed, size, rng)
    walls = outer_walls(size)
    _build_shell(plan, walls)
    lanes = _lane_positions(size)
    _add_doors(plan, walls[1], lanes)
    _add_vehicles(plan, lanes)
    fill.place_centred(plan, walls[3], "door", building.door(rng), rng.uniform(1.2, size[1] - 1.2), 1.2)
    for wall in (walls[0], walls[2], walls[3]):
        fill.furnish_wall(plan, wall, _GEAR, (0.4, 1.7))
        fill.hang_on_wall(plan, wall, _HANGINGS, max(1, int(0.45 * wall.length)), 2.4)
    _add_lights(plan, walls)
    clear_floor(plan, _MIN_WALKABLE, _GEAR)
    return plan.to_layout(ambient=0.3)


def _build_shell(plan: LayoutBuilder, walls: tuple[Wall, ...]) -> None:
    """Paint, darker up to shoulder height; a smooth floor."""
    rng = plan.rng
    dado = Material("paint", 0, gray=float(rng.uniform(85, 125)))
    wall = Material("paint", 1, gray=float(rng.uniform(145, 170)))
    floor = Material("screed", 0, gray=float(rng.uniform(100, 135)), contrast=0.65)
    build_enclosure(
        plan, [(rng.uniform(1.1, 1.5), dado), (plan.size[2], wall)], floor, Material("paint", 0, gray=165)
    )
    add_floor_joints(plan)
    add_skirting(plan, walls)


def _lane_positions(size: Size) -> list[float]:
    """Return the y of each vehicle's middle."""
    count = max(1, min(4, int((size[1] - 1.5) / 3.7)))
    return [size[1] * (k + 0.5) / count for k in range(count)]


def _add_doors(plan: LayoutBuilder, wall: Wall, lanes: list[float]) -> None:
    height = min(3.0, plan.size[2] - 0.6)
    for y in lanes:
        width = min(2.9, wall.length / len(lanes) - 0.6)
        fill.place_centred(
            plan, wall, "roller door", building.roller_door(plan.rng, width, height), wall.length - y, 1.0
        )


def _add_vehicles(plan: LayoutBuilder, lanes: list[float]) -> None:
    """One vehicle a lane; the first always, in large halls a lane may be empty."""
    x, rng = plan.size[0], plan.rng
    for k, y in enumerate(lanes):
        if k and rng.random() < 0.25:
            continue
        room = x - 2 * _AISLE_M - 0.9
        if room > 5.5 and (k == 0 or rng.random() < 0.5):
            name, shape = "fire engine", vehicles.fire_engine(rng, min(rng.uniform(5.6, 7.2), room))
        elif rng.random() < 0.5:
            name, shape = "fire engine", vehicles.fire_engine(rng, min(rng.uniform(3.9, 4.3), room), 1.85)
        else:
            name, shape = "van", vehicles.van(rng, min(rng.uniform(3.9, 4.4), room))
        length = float(np.ptp(shape.bounding_box[:, 1]))
        rear = (x - length) / 2 + rng.uniform(-0.15, 0.15)
        at = y + rng.uniform(-0.15, 0.15)
        plan.add_if_free(name, shape.placed_at(rear, at, 0, np.pi / 2))
        half = float(shape.bounding_box[1, 0]) + 0.25
        for side in (-half, half):
            fill.paint_line(plan, (rear - 0.3, at + side), (rear + length + 0.3, at + side), 0.1)


_GEAR: dict[str, tuple[float, ShapeMaker]] = {
    "lockers": (2, lambda r: storage.lockers(r, int(r.integers(2, 6)))),
    "gear": (2, lambda r: storage.cloakroom(r, int(r.integers(2, 5)))),
    "hose rack": (1.5, lambda r: equipment.hose_rack(r, r.uniform(1.3, 2.0), int(r.integers(2, 4)))),
    "hoses": (1, lambda r: equipment.drying_hoses(r, int(r.integers(2, 5)), r.uniform(1.7, 2.2))),
    "hose reel": (1, equipment.hose_reel),
    "bench": (1, lambda r: equipment.bench(r, r.uniform(1.2, 2.0))),
    "extinguisher": (1, equipment.extinguisher),
    "workbench": (0.5, lambda r: equipment.workbench(r, r.uniform(1.3, 1.8))),
    "cupboard": (0.3, lambda r: storage.cupboard(r, 1.0, 0.36, 1.8)),
    "tool box": (0.5, equipment.tool_box),
    "ladder": (0.5, lambda r: equipment.leaning_ladder(r, 2.0)),
    "cones": (0.7, equipment.cones),
    "radiator": (1, lambda r: building.radiator(r, r.uniform(0.8, 1.5))),
    "bin": (0.5, storage.waste_bin),
}

_HANGINGS: dict[str, tuple[float, ShapeMaker]] = {
    "sign": (2, building.sign),
    "notice": (2, building.notice),
    "pin board": (0.5, building.pin_board),
    "fuse box": (0.7, building.fuse_box),
}


def _add_lights(plan: LayoutBuilder, walls: tuple[Wall, ...]) -> None:
    x, y, z = plan.size
    columns, rows, rng = max(2, round(x / 3.5)), max(2, round(y / 3.5)), plan.rng
    xs, ys = ([n * (k + 0.5) / c for k in range(c)] for n, c in ((x, columns), (y, rows)))
    fill.light_tubes(plan, xs, ys, 1.5, 0.0)
    for wall in (walls[0], walls[2]):
        for k in range(int(wall.length / 3)):
            if rng.random() < 0.5:
                shape = building.window(rng, 1.6, 0.7)
                fill.add_window(plan, wall, 1.5 + 3 * k, z - 1.15, shape, rng.uniform(0.5, 1.3))
