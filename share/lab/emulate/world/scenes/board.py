"""A plain room with a calibration board on a stand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from share.geometry import se3
from share.lab.calibrate.target import AprilGrid, CharucoBoard, Target
from share.lab.emulate.world.furniture import board
from share.lab.emulate.world.layout import Layout, PlacedTarget
from share.lab.emulate.world.materials import Material
from share.lab.emulate.world.scenes import fill
from share.lab.emulate.world.scenes.layout_builder import LayoutBuilder, Size
from share.lab.emulate.world.scenes.shell import build_enclosure
from share.types import F64

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
        "board", board.board_on_stand(target, T, rng), is_reserved=True
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
