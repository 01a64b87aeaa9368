"""A plain room with a calibration board on a stand, its target printed exactly in tiles without seams.

The texels of all tiles lie on one lattice, and tiles begin at multiples of 32 of them: so the texels of the
first five mip levels are on one lattice too, and two tiles are equal at their seam. A tile's picture
continues beyond its edges, so that interpolation does not reach the opposite edge of the picture.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from share.geometry import se3
from share.lab.calibrate.target import AprilGrid, CharucoBoard, Target
from share.lab.calibrate.target_sheet import black_rectangles, darkness_image
from share.lab.emulate.types import Mesh
from share.lab.emulate.world.furniture.parts import box_on, pick_material
from share.lab.emulate.world.layout import Layout, PlacedTarget
from share.lab.emulate.world.materials import GivenMaterial, Material
from share.lab.emulate.world.mesh import Rng, Shape, box, concat_shapes
from share.lab.emulate.world.noise import PICTURE_TEXELS
from share.lab.emulate.world.scenes import fill
from share.lab.emulate.world.scenes.layout_builder import LayoutBuilder, Size, build_enclosure
from share.types import F64, U8

WHITE, BLACK = 205, 22  # albedo of paper and toner
MARGIN = 0.025  # of white around the print, at least
_GUARD_TEXELS = 32  # texels of a tile's picture beyond each side of the tile
_TILE_TEXELS = PICTURE_TEXELS - 2 * _GUARD_TEXELS
_MAX_TEXEL_M = 0.0008
_PLATE_M = 0.012


def printed_sheet(target: Target) -> tuple[Shape, F64]:
    """Return the printed sheet in the target's frame, and its extent (2, 2) m."""
    low, high = target.extent
    tiles, texel = _tile_division(target)
    spare = (tiles * _TILE_TEXELS - (high - low) / texel) / 2
    start = low - np.floor(spare + 1e-6) * texel  # whole texels: edges stay on the lattice
    paper = np.stack([low - MARGIN, high + MARGIN])
    rectangles = black_rectangles(target)
    parts = [
        _tile_shape(rectangles, start + texel * _TILE_TEXELS * np.array([i, j]), texel, paper)
        for j in range(tiles[1])
        for i in range(tiles[0])
    ]
    return concat_shapes(*parts), paper


def board_on_stand(target: Target, T_stand_target: F64, rng: Rng) -> Shape:
    """Return the sheet on a plate on a post; z = 0 of the stand's frame is the floor."""
    paper, extent = printed_sheet(target)
    plate = box(
        (*(extent[0] - 0.006), -_PLATE_M), (*(extent[1] + 0.006), -0.001), pick_material(rng, "plywood"), rng
    )
    middle = T_stand_target[:3, :3] @ [*extent.mean(axis=0), -0.08] + T_stand_target[:3, 3]
    steel = pick_material(rng, "steel")
    post = box_on((*middle[:2], 0.0), (0.04, 0.04, middle[2]), steel, rng)
    foot = box_on((*middle[:2], 0.0), (0.5, 0.5, 0.03), steel, rng)
    return concat_shapes(paper.transformed(T_stand_target), plate.transformed(T_stand_target), post, foot)


def _tile_division(target: Target) -> tuple[np.ndarray, float]:
    """Return the number of tiles (2,) and the texel size, m: the smallest that the limit on tiles allows.
    Edges of squares and of tag cells are whole numbers of texels, and of an AprilGrid's gap if tag_spacing is
    a multiple of a tenth."""
    cell = target.tag_size / 10 if isinstance(target, AprilGrid) else target.square / 16
    size = np.ptp(target.extent, axis=0) + 2 * MARGIN
    tiles = np.ceil(size * np.ceil(cell / _MAX_TEXEL_M) / cell / _TILE_TEXELS).astype(int)
    return tiles, float(cell / np.floor((tiles * _TILE_TEXELS * cell / size).min()))


def _tile_shape(rectangles: F64, low: F64, texel: float, paper: F64) -> Shape:
    """Return the print on the paper of the tile with its lower left corner at `low` (2,) m."""
    steps = (np.arange(PICTURE_TEXELS + 1) - _GUARD_TEXELS) * texel
    xs, ys = low[0] + steps, low[1] + _TILE_TEXELS * texel - steps
    pixels: U8 = (WHITE + (BLACK - WHITE) * darkness_image(rectangles, xs, ys)).round().astype(np.uint8)
    ends = np.stack([low, low + _TILE_TEXELS * texel]).clip(*paper)
    corners = np.array([(ends[i, 0], ends[j, 1]) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    mesh = Mesh(
        vertices=np.column_stack([corners, np.zeros(4)]).astype(np.float32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (4, 1)),
        uv=(np.stack([corners[:, 0] - xs[0], ys[0] - corners[:, 1]], 1) / (PICTURE_TEXELS * texel)).astype(
            np.float32
        ),
        layer=np.zeros(4, np.int32),
        faces=np.array([(0, 1, 2), (0, 2, 3)], np.int32),
    )
    return Shape(mesh, (GivenMaterial(pixels),))


_FROM_WALL, _HEIGHT = 1.3, 1.35  # m, of the board's middle
_MAX_YAW, _MAX_LEAN = 0.25, 0.12  # rad
_BRIGHTNESS = 1.7  # bright, for short exposures


def april_grid_scene(seed: int, size: Size) -> Layout:
    """The room with Kalibr's usual AprilGrid: 6 x 6 tags of 88 mm."""
    return board_scene(AprilGrid(), seed, size)


def charuco_scene(seed: int, size: Size) -> Layout:
    """The room with a ChArUco board of 9 x 7 squares of 80 mm."""
    return board_scene(CharucoBoard(), seed, size)


def board_scene(target: Target, seed: int, size: Size) -> Layout:
    """The room with a given target before the wall at x = 0, looking along +x, turned and tilted a little by
    the seed."""
    rng = np.random.default_rng([seed, 17])
    plan = LayoutBuilder("board", seed, size, rng)
    dull = Material("plaster", 0, gray=120, contrast=0.5)
    build_enclosure(
        plan, [(size[2], dull)], Material("screed", 0, contrast=0.5), Material("paint", 1, gray=185)
    )
    T = _board_pose(target, size, rng)
    plan.add_to_shell(
        "board", board_on_stand(target, T, rng), is_reserved=True
    )  # in the shell, so that no path removes it
    xs, ys = [size[0] * f for f in (0.3, 0.55, 0.8)], [size[1] * f for f in (0.2, 0.5, 0.8)]
    fill.light_tubes(plan, xs, ys, 1.2, 0.0)
    return replace(plan.to_layout(ambient=0.6), brightness=_BRIGHTNESS, target=PlacedTarget(target, T))


def _board_pose(target: Target, size: Size, rng: np.random.Generator) -> F64:
    """Return T_world_target (4, 4), with the target's middle at a fixed place."""
    upright = np.array([(0.0, 0, 1), (1, 0, 0), (0, 1, 0)])  # x right, y up, z out, as seen along -x
    yaw, lean, roll = rng.uniform(-1, 1, 3) * (_MAX_YAW, _MAX_LEAN, 0.03)
    R = se3.so3_exp(np.array([0, 0, yaw])) @ se3.so3_exp(np.array([roll, lean, 0])) @ upright
    middle = np.array([*target.extent.mean(axis=0), 0])
    return se3.from_rt(R, np.array([_FROM_WALL, size[1] / 2, _HEIGHT]) - R @ middle)
