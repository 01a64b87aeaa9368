"""The rooms that come with SHARE: seeded layouts by name, each with its purpose and its range of sizes."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from dataclasses import dataclass

from share.errors import UsageError
from share.lab.emulate.world.layout import Layout
from share.lab.emulate.world.scenes.board import april_grid_scene, charuco_scene
from share.lab.emulate.world.scenes.firestation import firestation
from share.lab.emulate.world.scenes.hard_rooms import corridor_twins, whitewall
from share.lab.emulate.world.scenes.layout_builder import Size
from share.lab.emulate.world.scenes.warehouse import warehouse


@dataclass(frozen=True)
class SceneEntry:
    """furnish: (seed, size) -> layout. Sizes in m, (x, y, z): the default and the limits."""

    description: str
    furnish: Callable[[int, Size], Layout]
    default: Size
    smallest: Size
    largest: Size


SCENES = {
    "warehouse": SceneEntry(
        "racks, cartons, pillars, signs: many features", warehouse, (9, 6, 4), (8, 6, 3.6), (30, 20, 8)
    ),
    "firestation": SceneEntry(
        "plain walls and floor, vehicles, lockers, hoses: few cues",
        firestation,
        (14, 9, 4.5),
        (9, 6, 3.6),
        (30, 20, 8),
    ),
    "corridor-twins": SceneEntry(
        "two corridors that look alike: tempts to wrong merges",
        corridor_twins,
        (18, 8, 2.9),
        (9, 6, 2.7),
        (40, 14, 4),
    ),
    "whitewall": SceneEntry(
        "white walls, next to nothing to see", whitewall, (9, 6, 4), (6, 5, 2.7), (15, 12, 6)
    ),
    "board": SceneEntry(
        "an AprilGrid on a stand: to calibrate with", april_grid_scene, (5, 5, 3), (4, 4, 2.6), (9, 9, 4)
    ),
    "charuco-board": SceneEntry(
        "the same with a ChArUco board", charuco_scene, (5, 5, 3), (4, 4, 2.6), (9, 9, 4)
    ),
}


def make_scene_layout(name: str, seed: int, size: Size | None = None) -> Layout:
    """Return the room `name` of this seed; `size` (x, y, z) m instead of its default. Deterministic. Raises
    UsageError for an unknown scene or an unsupported size, ValueError for a negative seed."""
    if name not in SCENES:
        known = (*SCENES, "plain")
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}, or give a .glb file"
        raise UsageError(f"scene '{name}' is not known; {hint}")
    if seed < 0:
        raise ValueError(f"seed {seed} must not be negative")
    scene = SCENES[name]
    return scene.furnish(seed, _checked_size(name, scene, size) if size else scene.default)


def _checked_size(name: str, scene: SceneEntry, size: Size) -> Size:
    limits = list(zip(scene.smallest, size, scene.largest, strict=True))
    if not all(math.isfinite(v) and low <= v <= high for low, v, high in limits):
        min_text, max_text = (" x ".join(f"{v:g}" for v in s) for s in (scene.smallest, scene.largest))
        size_text = " x ".join(f"{v:g}" for v in size)
        raise UsageError(
            f"a {name} cannot be {size_text} m: give a size between {min_text} m and {max_text} m"
        )
    x, y, z = (float(v) for v in size)
    return x, y, z
