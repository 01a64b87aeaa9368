"""A room before it has pictures and light: its objects and lamps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from share.lab.calibrate.target import Target
from share.lab.emulate.world.mesh import Shape
from share.lab.emulate.world.proximity import is_near_mesh
from share.types import F64


@dataclass(frozen=True, eq=False)
class Piece:
    """One object: a shelf with everything on it. name: unique in the layout. solid: an obstacle to bodies (a
    decal, a cable or a high lamp is none)."""

    name: str
    shape: Shape
    solid: bool = True

    @property
    def bounding_box(self) -> F64:
        """Return lower and upper corner (2, 3) m."""
        return self.shape.bounding_box


@dataclass(frozen=True)
class Light:
    """A rectangular panel that emits to one side. position: its middle, m. power: relative to the other
    lights (the room is scaled to a mean brightness). size: its extent, m. facing: its direction."""

    position: tuple[float, float, float]
    power: float = 1.0
    size: tuple[float, float] = (1.2, 0.3)
    facing: tuple[float, float, float] = (0.0, 0.0, -1.0)


@dataclass(frozen=True, eq=False)
class PlacedTarget:
    """A calibration target in a room. T_world_target (4, 4): frame as in `share.lab.calibrate.target`."""

    target: Target
    T_world_target: F64


@dataclass(frozen=True, eq=False)
class Layout:
    """size: extent (3,) m from the origin. shell: walls, floor, ceiling and what carries them, facing
    inwards, never removed. pieces: everything else. ambient: uniform light, as a share of the mean.
    brightness: mean light, 1 = albedo is the gray level. target: calibration target, if any."""

    name: str
    seed: int
    size: tuple[float, float, float]
    shell: tuple[Piece, ...]
    pieces: tuple[Piece, ...]
    lights: tuple[Light, ...]
    ambient: float = 0.15
    brightness: float = 1.0
    target: PlacedTarget | None = None

    @property
    def all_pieces(self) -> tuple[Piece, ...]:
        """Return shell and pieces."""
        return self.shell + self.pieces

    def without(self, positions: F64, clearance: float) -> tuple[Layout, tuple[str, ...]]:
        """Return the room without the solid pieces that are nearer than `clearance` m to any of `positions`
        (N, 3) m or contain one, and the names of the removed pieces. The shell always stays."""
        blocked = [
            piece.solid and is_near_mesh(piece.shape.mesh, positions, clearance) for piece in self.pieces
        ]
        remaining = tuple(p for p, is_removed in zip(self.pieces, blocked, strict=True) if not is_removed)
        removed = tuple(p.name for p, is_removed in zip(self.pieces, blocked, strict=True) if is_removed)
        return replace(self, pieces=remaining), removed

    def __post_init__(self) -> None:
        names = [piece.name for piece in self.all_pieces]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"layout: two pieces are named '{twice}'")
        if not all(np.isfinite(piece.bounding_box).all() for piece in self.all_pieces):
            raise ValueError("layout: a piece has corners that are not finite")
