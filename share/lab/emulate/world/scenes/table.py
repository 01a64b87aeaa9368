"""Every scene by its name, what it is for, and how large it may be."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from share.errors import UsageError
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.scenes.board import april_grid, charuco
from share.lab.emulate.world.scenes.corridor import corridor_twins
from share.lab.emulate.world.scenes.firestation import firestation
from share.lab.emulate.world.scenes.plan import Size
from share.lab.emulate.world.scenes.warehouse import warehouse
from share.lab.emulate.world.scenes.whitewall import whitewall


@dataclass(frozen=True)
class Scene:
    """furnish: (seed, size) -> layout. Sizes in m, (x, y, z): the usual one and the limits."""

    about: str
    furnish: Callable[[int, Size], Layout]
    default: Size
    smallest: Size
    largest: Size


SCENES = {
    "warehouse": Scene(
        "racks, cartons, pillars, signs: many features", warehouse, (9, 6, 4), (8, 6, 3.6), (30, 20, 8)
    ),
    "firestation": Scene(
        "plain walls and floor, vehicles, lockers, hoses: few cues",
        firestation,
        (14, 9, 4.5),
        (9, 6, 3.6),
        (30, 20, 8),
    ),
    "corridor-twins": Scene(
        "two corridors that look alike: tempts to wrong merges",
        corridor_twins,
        (18, 8, 2.9),
        (9, 6, 2.7),
        (40, 14, 4),
    ),
    "whitewall": Scene("white walls, next to nothing to see", whitewall, (9, 6, 4), (6, 5, 2.7), (15, 12, 6)),
    "board": Scene(
        "an AprilGrid on a stand: to calibrate with", april_grid, (5, 5, 3), (4, 4, 2.6), (9, 9, 4)
    ),
    "charuco-board": Scene("the same with a ChArUco board", charuco, (5, 5, 3), (4, 4, 2.6), (9, 9, 4)),
}


def layout(name: str, seed: int, size: Size | None = None) -> Layout:
    """The room `name` of this seed; `size` (x, y, z) m instead of its usual one. The same arguments give
    the same room, another seed another one. Raises UsageError for an unknown scene or a size it cannot
    be built in, ValueError for a negative seed."""
    if name not in SCENES:
        raise UsageError(f"no scene is named '{name}'; there are: {', '.join(SCENES)}")
    if seed < 0:
        raise ValueError(f"seed {seed} must not be negative")
    scene = SCENES[name]
    return scene.furnish(seed, _checked(name, scene, size) if size else scene.default)


def _checked(name: str, scene: Scene, size: Size) -> Size:
    limits = list(zip(scene.smallest, size, scene.largest, strict=True))
    if not all(math.isfinite(v) and low <= v <= high for low, v, high in limits):
        least, most = (" x ".join(f"{v:g}" for v in s) for s in (scene.smallest, scene.largest))
        asked = " x ".join(f"{v:g}" for v in size)
        raise UsageError(f"a {name} cannot be {asked} m: give a size between {least} m and {most} m")
    x, y, z = (float(v) for v in size)
    return x, y, z
