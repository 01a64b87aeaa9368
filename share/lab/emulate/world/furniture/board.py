"""A calibration board: its target printed exactly, in tiles whose seams nobody can see.

The texels of all tiles lie on one lattice, and tiles begin at multiples of 32 of them: then the texels of
the first five mip levels lie on one lattice too, and two tiles show the same at their seam. What a tile
shows goes on beyond its edges, so that nothing is interpolated with the other end of its picture.
"""

from __future__ import annotations

import numpy as np

from share.lab.calibrate.target import AprilGrid, Target
from share.lab.calibrate.target_sheet import darkness, ink
from share.lab.emulate.types import Mesh
from share.lab.emulate.world.furniture.parts import block, pick
from share.lab.emulate.world.materials import Given
from share.lab.emulate.world.mesh import Rng, Shape, box, concat
from share.lab.emulate.world.noise import P
from share.types import F64, U8

WHITE, BLACK = 205, 22  # albedo of paper and toner
MARGIN = 0.025  # m of white around what is printed, at least
_GUARD = 32  # texels of a tile's picture that lie beyond the tile, on each side
_TILE = P - 2 * _GUARD
_COARSEST = 0.0008  # m a texel
_THICK = 0.012


def sheet(target: Target) -> tuple[Shape, F64]:
    """The printed sheet in the target's own frame, and its extent (2, 2) m."""
    low, high = target.extent
    tiles, texel = _division(target)
    spare = (tiles * _TILE - (high - low) / texel) / 2
    start = low - np.floor(spare + 1e-6) * texel  # whole texels: edges stay on the lattice
    paper = np.stack([low - MARGIN, high + MARGIN])
    rectangles = ink(target)
    parts = [
        _tile(rectangles, start + texel * _TILE * np.array([i, j]), texel, paper)
        for j in range(tiles[1])
        for i in range(tiles[0])
    ]
    return concat(parts), paper


def on_stand(target: Target, T_stand_target: F64, rng: Rng) -> Shape:
    """The sheet on a plate on a post; the floor is z = 0 of the stand's frame."""
    paper, extent = sheet(target)
    plate = box((*(extent[0] - 0.006), -_THICK), (*(extent[1] + 0.006), -0.001), pick(rng, "plywood"), rng)
    middle = T_stand_target[:3, :3] @ [*extent.mean(axis=0), -0.08] + T_stand_target[:3, 3]
    steel = pick(rng, "steel")
    post = block((*middle[:2], 0.0), (0.04, 0.04, middle[2]), steel, rng)
    foot = block((*middle[:2], 0.0), (0.5, 0.5, 0.03), steel, rng)
    return concat([paper.moved(T_stand_target), plate.moved(T_stand_target), post, foot])


def _division(target: Target) -> tuple[np.ndarray, float]:
    """How many tiles (2,), and m a texel: as small as so many allow. An edge of a chessboard's square or
    of a tag's cell is a whole number of texels, and of an AprilGrid's gap, if tag_spacing is a tenth."""
    cell = target.tag_size / 10 if isinstance(target, AprilGrid) else target.square / 16
    size = np.ptp(target.extent, axis=0) + 2 * MARGIN
    tiles = np.ceil(size * np.ceil(cell / _COARSEST) / cell / _TILE).astype(int)
    return tiles, float(cell / np.floor((tiles * _TILE * cell / size).min()))


def _tile(rectangles: F64, low: F64, texel: float, paper: F64) -> Shape:
    """What lies on the paper of the tile with its lower left corner at `low` (2,) m."""
    steps = (np.arange(P + 1) - _GUARD) * texel
    xs, ys = low[0] + steps, low[1] + _TILE * texel - steps
    pixels: U8 = (WHITE + (BLACK - WHITE) * darkness(rectangles, xs, ys)).round().astype(np.uint8)
    ends = np.stack([low, low + _TILE * texel]).clip(*paper)
    corners = np.array([(ends[i, 0], ends[j, 1]) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    mesh = Mesh(
        vertices=np.column_stack([corners, np.zeros(4)]).astype(np.float32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (4, 1)),
        uv=(np.stack([corners[:, 0] - xs[0], ys[0] - corners[:, 1]], 1) / (P * texel)).astype(np.float32),
        layer=np.zeros(4, np.int32),
        faces=np.array([(0, 1, 2), (0, 2, 3)], np.int32),
    )
    return Shape(mesh, (Given(pixels),))
