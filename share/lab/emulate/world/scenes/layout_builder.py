"""A room while it is being furnished: objects and free space."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from share.lab.emulate.world.layout import Layout, Light, Piece
from share.lab.emulate.world.mesh import Rng, Shape
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

    def place(self, shape: Shape, position: float, z: float = 0.0, distance: float = 0.0) -> Shape:
        """Return `shape` with its middle `position` m along the wall, `z` m up and its back `distance` m off
        it."""
        return shape.placed_at(*self.point_before(position, distance), z, self.yaw)

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
