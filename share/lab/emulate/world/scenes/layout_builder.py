"""A room while it is being furnished: walls, floor and ceiling, what carries them, objects and free space."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from share.lab.emulate.world.furniture import building
from share.lab.emulate.world.furniture.parts import box_on, pick_material
from share.lab.emulate.world.layout import Layout, Light, Piece
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.mesh import Rng, Shape, concat_shapes, decal, panels, quad
from share.types import F64

Size = tuple[float, float, float]
Walls = tuple["Wall", "Wall", "Wall", "Wall"]

_TOUCH_M = 1e-4  # nearer than this, boxes only touch


@dataclass(frozen=True)
class Wall:
    """A wall as seen from the room: (x, y) m of its left end, its direction to the right (yaw, rad), its
    length and height m. Furniture has the wall's frame: x along it, -y into the room."""

    x: float
    y: float
    yaw: float
    length: float
    height: float

    def place(self, shape: Shape, position: float, z: float = 0.0) -> Shape:
        """Return `shape` with its back to the wall, its middle `position` m along it, `z` m up."""
        return shape.placed_at(*self.point_before(position, 0.0), z, self.yaw)

    def point_before(self, position: float, distance: float) -> tuple[float, float]:
        """Return the place (x, y) m, `position` m along the wall and `distance` m off it."""
        c, s = float(np.cos(self.yaw)), float(np.sin(self.yaw))
        return self.x + c * position + s * distance, self.y + s * position - c * distance


def outer_walls(size: Size) -> Walls:
    """Return the north, east, south and west wall, seen from inside."""
    x, y, z = size
    return (
        Wall(0, y, 0, x, z),
        Wall(x, y, -np.pi / 2, y, z),
        Wall(x, 0, np.pi, x, z),
        Wall(0, 0, np.pi / 2, y, z),
    )


@dataclass(eq=False)
class LayoutBuilder:
    """Collects pieces and keeps them apart: no two bounding boxes overlap."""

    name: str
    seed: int
    size: Size
    rng: Rng
    shell: list[Piece] = field(default_factory=list)
    pieces: list[Piece] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    occupied_boxes: list[F64] = field(default_factory=list)

    def is_free(self, bounds: F64) -> bool:
        """Return whether a box (2, 3) m lies inside the room and overlaps nothing."""
        if (bounds[0] < -_TOUCH_M).any() or (bounds[1] > np.array(self.size) + _TOUCH_M).any():
            return False
        if not self.occupied_boxes:
            return True
        boxes = np.stack(self.occupied_boxes)
        apart = (boxes[:, 1] <= bounds[0] + _TOUCH_M) | (boxes[:, 0] >= bounds[1] - _TOUCH_M)
        return bool(apart.any(axis=1).all())

    def add_to_shell(self, name: str, shape: Shape, is_reserved: bool = False) -> None:
        """Add to the shell without a check; `is_reserved`: nothing may overlap it."""
        self.shell.append(Piece(f"{name} {len(self.shell)}", shape))
        if is_reserved:
            self.occupied_boxes.append(shape.bounding_box)

    def add_if_free(self, name: str, shape: Shape, solid: bool = True) -> bool:
        """Add a piece if its place is free; return whether it was."""
        if not self.is_free(shape.bounding_box):
            return False
        self.occupied_boxes.append(shape.bounding_box)
        self.add_unchecked(name, shape, solid)
        return True

    def add_unchecked(self, name: str, shape: Shape, solid: bool = False) -> None:
        """Add a piece without a check: paint on a floor, a plate on a placed piece."""
        self.pieces.append(Piece(f"{name} {len(self.pieces)}", shape, solid))

    def reserve(self, bounds: F64) -> None:
        """Keep a box (2, 3) m free of later pieces."""
        self.occupied_boxes.append(bounds)

    def to_layout(self, ambient: float, brightness: float = 1.0) -> Layout:
        """Return the layout."""
        parts = tuple(self.shell), tuple(self.pieces), tuple(self.lights)
        return Layout(self.name, self.seed, self.size, *parts, ambient, brightness)


# Walls, floor, ceiling and what carries them.

BAY_M = 3.0  # about, between columns and girders


def bay_joints(length: float, pitch: float = BAY_M) -> list[float]:
    """Return where the bays of a wall meet, m from its left end, without the ends."""
    count = max(1, round(length / pitch))
    return [length * k / count for k in range(1, count)]


Bands = Sequence[tuple[float, Material]]  # of a wall, lowest first: (upper edge m, material)


def wall_surface(wall: Wall, bands: Bands, rng: Rng, pitch: float = np.inf) -> Shape:
    """Return the wall in bays of about `pitch` m without repetition; the joints between them show."""
    edges, out = [0.0, *bay_joints(wall.length, pitch), wall.length], []
    for left, right in pairwise(edges):
        low = 0.0
        for high, skin in bands:
            out.append(quad((left, 0, low), (right - left, 0, 0), (0, 0, high - low), skin, rng))
            low = high
    return wall.place(concat_shapes(*out), 0)


def build_enclosure(
    plan: LayoutBuilder, bands: Bands, floor: Material, ceiling: Material, pitch: float = np.inf
) -> None:
    """The four walls in bays of `pitch` m, the floor in slabs, the ceiling."""
    x, y, z = plan.size
    for wall in outer_walls(plan.size):
        plan.add_to_shell("wall", wall_surface(wall, bands, plan.rng, pitch))
    plan.add_to_shell("floor", panels((0, 0, 0), (x, 0, 0), (0, y, 0), [floor], BAY_M, plan.rng))
    plan.add_to_shell(
        "ceiling", panels((0, y, z), (x, 0, 0), (0, -y, 0), [ceiling], min(pitch, 1e3), plan.rng)
    )


def add_floor_joints(plan: LayoutBuilder) -> None:
    """Sealed joints of the floor slab, where its panels meet."""
    x, y, _ = plan.size
    skin = Material("rubber", 1, gray=62)
    for at in bay_joints(x):
        plan.add_unchecked(
            "joint", decal((at - 0.006, 0, 0), (0.012, 0, 0), (0, y, 0), skin, plan.rng, offset=0.0015)
        )
    for at in bay_joints(y):
        plan.add_unchecked(
            "joint", decal((0, at - 0.006, 0), (x, 0, 0), (0, 0.012, 0), skin, plan.rng, offset=0.001)
        )


def add_columns(plan: LayoutBuilder, walls: Sequence[Wall], height: float) -> None:
    """Half columns of `height` m where the bays of walls meet."""
    skin, wide, deep = pick_material(plan.rng, "steel"), 0.16, 0.12
    for wall in walls:
        for at in bay_joints(wall.length):
            post = box_on((0, -deep / 2, 0), (wide, deep, height), skin, plan.rng)
            plan.add_to_shell("column", wall.place(post, at), is_reserved=True)


def add_girders(plan: LayoutBuilder, height: float) -> None:
    """I-beams across the room under its ceiling, over the columns."""
    x, y, z = plan.size
    for at in bay_joints(x):
        beam = building.girder(plan.rng, y, height)
        plan.add_to_shell("girder", beam.placed_at(at, y / 2, z - height, np.pi / 2), is_reserved=True)


def add_skirting(plan: LayoutBuilder, walls: Sequence[Wall]) -> None:
    """A rubber strip of 8 cm along the foot of walls."""
    for wall in walls:
        strip = decal(
            (0, 0, 0), (wall.length, 0, 0), (0, 0, 0.08), Material("rubber"), plan.rng, offset=0.002
        )
        plan.add_unchecked("skirting", wall.place(strip, 0))


# Free floor between the furniture.

_STEP = 0.1
_WALKER_CLEARANCE_M = 0.45  # least distance of a walker's middle from objects
_MIN_OBSTACLE_M, _MAX_OBSTACLE_M = 0.1, 1.9  # obstacles are objects between these heights


def clear_floor(plan: LayoutBuilder, min_share: float, names: Collection[str]) -> None:
    """Remove pieces of these `names`, the last first, until a connected share `min_share` of the floor is
    walkable, or none are left."""
    while walkable_share(plan) < min_share:
        removed = next((p for p in reversed(plan.pieces) if p.name.rpartition(" ")[0] in names), None)
        if removed is None:
            return
        plan.pieces.remove(removed)


def walkable_share(plan: LayoutBuilder) -> float:
    """Return the largest connected area for a walker's middle, as a share of the floor; objects count as
    their boxes, so it is a little less than by `Occupancy`."""
    import cv2

    free = np.ones(np.ceil(np.array(plan.size[:2]) / _STEP - 1e-6).astype(int), np.uint8)
    for piece in plan.pieces:
        low, high = piece.bounding_box
        if piece.solid and low[2] < _MAX_OBSTACLE_M and high[2] > _MIN_OBSTACLE_M:
            (a, b), (c, d) = np.floor(low[:2] / _STEP + 1e-6), np.ceil(high[:2] / _STEP - 1e-6)
            free[max(int(a), 0) : int(c), max(int(b), 0) : int(d)] = 0
    cells = cv2.distanceTransform(np.pad(free, 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    middle = ((cells - 0.5) * _STEP >= _WALKER_CLEARANCE_M).astype(np.uint8)
    _, _, places, _ = cv2.connectedComponentsWithStats(middle, connectivity=4)
    return float(places[1:, cv2.CC_STAT_AREA].max(initial=0)) / free.size
