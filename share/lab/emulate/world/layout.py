"""A room before it has pictures and light: its objects and lamps, and exact distances from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from share.lab.calibrate.target import Target
from share.lab.emulate.types import Mesh
from share.lab.emulate.world.mesh import Shape
from share.types import F64

_PAIR_CHUNK = 400_000  # point-triangle pairs at a time


def is_near_mesh(mesh: Mesh, points: F64, reach: float) -> bool:
    """Return whether any point (N, 3) m is nearer than `reach` m to the mesh, or inside it."""
    low, high = mesh.vertices.min(0) - reach, mesh.vertices.max(0) + reach
    near = points[((points >= low) & (points <= high)).all(axis=1)]
    if not len(near):
        return False
    corners = mesh.triangles.astype(float)
    step = max(1, _PAIR_CHUNK // len(corners))
    return any(
        bool(
            (triangle_distances(corners, part).min(1) < reach).any()
            or (winding_numbers(corners, part) > 0.5).any()
        )
        for part in (near[i : i + step] for i in range(0, len(near), step))
    )


def triangle_distances(corners: F64, points: F64) -> F64:
    """Return distances (N, F) m of points (N, 3) from triangles (F, 3, 3): to the plane where the foot of the
    perpendicular lies inside, else to the nearest edge."""
    p = points[:, None]
    edges = np.roll(corners, -1, axis=1) - corners
    out = np.full((len(points), len(corners)), np.inf)
    normal = np.cross(edges[:, 0], edges[:, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    inside = np.ones(out.shape, bool)
    for k in range(3):
        a, e = corners[:, k], edges[:, k]
        d = p - a
        t = (d * e).sum(-1) / np.maximum((e * e).sum(-1), 1e-18)
        foot = d - np.clip(t, 0, 1)[..., None] * e
        out = np.minimum(out, np.linalg.norm(foot, axis=-1))
        inside &= (d * np.cross(normal, e)).sum(-1) >= 0
    height = np.abs(((p - corners[:, 0]) * normal).sum(-1))
    return np.where(inside, np.minimum(height, out), out)


def winding_numbers(corners: F64, points: F64) -> F64:
    """Return the winding number (N,) of the triangles (F, 3, 3) around each point: about 1 inside a closed
    solid, 0 outside. Solid angles by van Oosterom & Strackee, IEEE TBME 30(2), 1983."""
    a, b, c = (corners[:, k] - points[:, None] for k in range(3))
    na, nb, nc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    top = (a * np.cross(b, c)).sum(-1)
    bottom = na * nb * nc + (a * b).sum(-1) * nc + (b * c).sum(-1) * na + (c * a).sum(-1) * nb
    total: F64 = np.arctan2(top, bottom).sum(1) / (2 * np.pi)
    return total


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
