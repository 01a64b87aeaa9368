"""Fill a room: along walls, on walls, under the ceiling, on the floor."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from share.lab.emulate.world.furniture import building
from share.lab.emulate.world.layout import Light
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, box, decal
from share.lab.emulate.world.scenes.layout_builder import LayoutBuilder, Wall

ShapeMaker = Callable[[Rng], Shape]

_SEARCH_M, _SEARCH_STEP_M = 1.0, 0.1  # search for a free place


def choose_weighted(rng: Rng, weights: Mapping[str, float]) -> str:
    """Return one of the names, drawn by weight."""
    share = np.array(list(weights.values()))
    return str(rng.choice(list(weights), p=share / share.sum()))


def furnish_wall(
    plan: LayoutBuilder,
    wall: Wall,
    makers: Mapping[str, tuple[float, ShapeMaker]],
    gaps: tuple[float, float],
) -> None:
    """Place furniture with its back to a wall, from left to right, with gaps (low, high) m between.
    makers: by name, weight and function."""
    rng, weights = plan.rng, {name: weight for name, (weight, _) in makers.items()}
    position = rng.uniform(*gaps)
    while position < wall.length - 0.3:
        name = choose_weighted(rng, weights)
        width = place_on_wall(plan, wall, name, makers[name][1](rng), position)
        position += width + rng.uniform(*gaps) if width else 0.3


def place_on_wall(plan: LayoutBuilder, wall: Wall, name: str, shape: Shape, left: float) -> float:
    """Place a shape at the first free place at or after `left` m, within a metre; return how far it
    reaches from `left`, or 0 if there was none."""
    wide = float(shape.bounding_box[1, 0] - shape.bounding_box[0, 0])
    for shift in np.arange(0, _SEARCH_M, _SEARCH_STEP_M):
        if left + shift + wide > wall.length:
            return 0.0
        middle = left + shift - float(shape.bounding_box[0, 0])
        if plan.add_if_free(name, wall.place(shape, middle)):
            return wide + float(shift)
    return 0.0


def place_centred(
    plan: LayoutBuilder, wall: Wall, name: str, shape: Shape, position: float, clear: float = 0.0
) -> bool:
    """Place a shape at a position along a wall, and keep `clear` m before it free of furniture; return
    whether it was free."""
    moved = wall.place(shape, position)
    if not plan.add_if_free(name, moved):
        return False
    if clear:
        _, wide = shape.bounding_box[:, 0]
        plan.reserve(wall.place(_reserved_box(float(wide), clear), position).bounding_box)
    return True


def _reserved_box(half: float, clear: float) -> Shape:
    """Return the space before an object that extends `half` m to each side of its middle."""
    return box((-half, -clear - 0.4, 0), (half, -0.4, 2.0), Material("paint"))


def hang_on_wall(
    plan: LayoutBuilder, wall: Wall, makers: Mapping[str, tuple[float, ShapeMaker]], count: int, top: float
) -> None:
    """Hang `count` objects on free parts of a wall, their middles between 1.2 and `top` m; leave out those
    that find no place in eight tries."""
    rng, weights = plan.rng, {name: weight for name, (weight, _) in makers.items()}
    for _ in range(count):
        name = choose_weighted(rng, weights)
        shape = makers[name][1](rng)
        tall, wide = float(shape.bounding_box[1, 2]), float(shape.bounding_box[1, 0])
        if 2 * wide + 0.1 > wall.length:
            continue
        for _try in range(8):
            z = rng.uniform(1.2, max(top, 1.3)) - tall / 2
            position = rng.uniform(wide + 0.05, wall.length - wide - 0.05)
            if plan.add_if_free(name, wall.place(shape, position, z)):
                break


def light_tubes(
    plan: LayoutBuilder, xs: Sequence[float], ys: Sequence[float], length: float, drop: float
) -> None:
    """Fluorescent lamps along x on a grid; brightness varies, a few are off."""
    z, rng = plan.size[2], plan.rng
    for x in xs:
        for y in ys:
            if plan.add_if_free(
                "lamp", building.tube_lamp(rng, length, drop).placed_at(x, y, z), solid=False
            ):
                power = rng.uniform(0.7, 1.3)
                plan.lights.append(building.tube_light(x, y, z, length, drop, power, along_y=False))


def light_bells(plan: LayoutBuilder, xs: Sequence[float], ys: Sequence[float], drop: float) -> None:
    """High-bay lamps on a grid."""
    z, rng = plan.size[2], plan.rng
    for x in xs:
        for y in ys:
            if plan.add_if_free("lamp", building.high_bay_lamp(rng, drop).placed_at(x, y, z), solid=False):
                plan.lights.append(building.high_bay_light(x, y, z, drop, rng.uniform(0.7, 1.3)))


def add_window(
    plan: LayoutBuilder, wall: Wall, position: float, sill: float, shape: Shape, power: float
) -> bool:
    """A window on a wall, its sill `sill` m up, with the light through it; return whether the place was
    free."""
    if not plan.add_if_free("window", wall.place(shape, position, sill)):
        return False
    width, height = float(np.ptp(shape.bounding_box[:, 0])), float(np.ptp(shape.bounding_box[:, 2]))
    c, s = float(np.cos(wall.yaw)), float(np.sin(wall.yaw))
    middle = (*wall.point_before(position, 0.12), sill + height / 2)
    plan.lights.append(Light(middle, power, (width, height), (s, -c, 0.0)))
    return True


def add_overhead_pipes(plan: LayoutBuilder, count: int) -> None:
    """Pipes and ducts along y under the ceiling, between girders and lamps, where there is room."""
    x, y, z = plan.size
    for _ in range(count):
        length = plan.rng.uniform(0.5, 0.97) * y
        if plan.rng.random() < 0.6:
            shape, tall = building.pipe_run(plan.rng, length, int(plan.rng.integers(1, 4))), 0.45
        else:
            shape, tall = building.duct(plan.rng, length), 0.5
        for _try in range(12):
            at = plan.rng.uniform(0.1, x - 0.5), plan.rng.uniform(length / 2, y - length / 2)
            if plan.add_if_free("pipes", shape.placed_at(*at, z - tall, np.pi / 2), solid=False):
                break


def paint_line(
    plan: LayoutBuilder, start: tuple[float, float], end: tuple[float, float], line_width: float = 0.08
) -> None:
    """A painted line on the floor, along x or along y; those along y lie above those along x."""
    (x0, y0), (x1, y1) = start, end
    skin = Material("marking", int(plan.rng.integers(2)))
    if y0 == y1:
        shape = decal(
            (min(x0, x1), y0 - line_width / 2, 0),
            (abs(x1 - x0), 0, 0),
            (0, line_width, 0),
            skin,
            plan.rng,
            offset=0.003,
        )
    else:
        shape = decal(
            (x0 - line_width / 2, min(y0, y1), 0),
            (line_width, 0, 0),
            (0, abs(y1 - y0), 0),
            skin,
            plan.rng,
            offset=0.004,
        )
    plan.add_unchecked("line", shape)


def paint_rectangle(plan: LayoutBuilder, low: tuple[float, float], high: tuple[float, float]) -> None:
    """A rectangle of painted lines."""
    (x0, y0), (x1, y1) = low, high
    for y in (y0, y1):
        paint_line(plan, (x0, y), (x1, y))
    for x in (x0, x1):
        paint_line(plan, (x, y0), (x, y1))
