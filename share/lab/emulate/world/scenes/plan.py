"""A room while it is being furnished: what stands where, and what is still free."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from share.lab.emulate.world.layout import Layout, Light, Piece
from share.lab.emulate.world.mesh import Rng, Shape
from share.types import F64

Size = tuple[float, float, float]
Walls = tuple["Wall", "Wall", "Wall", "Wall"]

_TOUCH = 1e-4  # m; nearer than this, things only touch


@dataclass(frozen=True)
class Wall:
    """A wall as one looks at it: (x, y) m of its left end, its direction from there to the right (yaw,
    rad), its length and height m. Furniture's own frame is the wall's: x along it, -y into the room."""

    x: float
    y: float
    yaw: float
    length: float
    height: float

    def put(self, shape: Shape, at: float, z: float = 0.0, away: float = 0.0) -> Shape:
        """`shape` with its middle `at` m along the wall, `z` m up and its back `away` m off it."""
        return shape.at(*self.point(at, away), z, self.yaw)

    def point(self, at: float, away: float) -> tuple[float, float]:
        """The place (x, y) m before the wall, `at` m along it and `away` m off it."""
        c, s = float(np.cos(self.yaw)), float(np.sin(self.yaw))
        return self.x + c * at + s * away, self.y + s * at - c * away


def outer_walls(size: Size) -> Walls:
    """North, east, south, west, seen from inside."""
    x, y, z = size
    return (
        Wall(0, y, 0, x, z),
        Wall(x, y, -np.pi / 2, y, z),
        Wall(x, 0, np.pi, x, z),
        Wall(0, 0, np.pi / 2, y, z),
    )


@dataclass(eq=False)
class Plan:
    """Collects pieces and keeps them apart: no two boxes around pieces overlap."""

    name: str
    seed: int
    size: Size
    rng: Rng
    shell: list[Piece] = field(default_factory=list)
    pieces: list[Piece] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    taken: list[F64] = field(default_factory=list)

    def free(self, bounds: F64) -> bool:
        """Whether a box (2, 3) m lies inside the room and meets nothing."""
        if (bounds[0] < -_TOUCH).any() or (bounds[1] > np.array(self.size) + _TOUCH).any():
            return False
        if not self.taken:
            return True
        boxes = np.stack(self.taken)
        apart = (boxes[:, 1] <= bounds[0] + _TOUCH) | (boxes[:, 0] >= bounds[1] - _TOUCH)
        return bool(apart.any(axis=1).all())

    def build(self, name: str, shape: Shape, keeps_off: bool = False) -> None:
        """Into the shell, as it is; `keeps_off`: nothing may overlap it."""
        self.shell.append(Piece(f"{name} {len(self.shell)}", shape))
        if keeps_off:
            self.taken.append(shape.bounds)

    def add(self, name: str, shape: Shape, solid: bool = True) -> bool:
        """Where it is, if that is free; whether it was."""
        if not self.free(shape.bounds):
            return False
        self.taken.append(shape.bounds)
        self.lay(name, shape, solid)
        return True

    def lay(self, name: str, shape: Shape, solid: bool = False) -> None:
        """Where it is, without asking: paint on a floor, a plate on something that was placed."""
        self.pieces.append(Piece(f"{name} {len(self.pieces)}", shape, solid))

    def reserve(self, bounds: F64) -> None:
        """Keep a box (2, 3) m free of whatever comes later."""
        self.taken.append(bounds)

    def done(self, ambient: float, brightness: float = 1.0) -> Layout:
        """The room as data."""
        parts = tuple(self.shell), tuple(self.pieces), tuple(self.lights)
        return Layout(self.name, self.seed, self.size, *parts, ambient, brightness)
